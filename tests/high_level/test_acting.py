"""Acting online: whatever is drawn comes from a key of its own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.data.device import Normaliser
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.acting import Acting
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.skill_learning import FrozenSkills
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.skills.chunks import ActionChunks
from tests.point import PointEnv, point_config

ENVIRONMENTS = 4


def word(key: jax.Array) -> jax.Array:
    """The second half of a key, as good as a name for it."""
    return jax.random.key_data(key)[..., 1].astype(jnp.int32)


class ShortEnv(PointEnv):
    """Every episode ends with its first step."""

    episode_length = 1


class Recording(FrozenSkills):
    """Skills that keep the keys they are given: for conduct, and for what is seen."""

    def start(self) -> Any:
        return jnp.zeros(2, jnp.int32)

    def conduct(self, seen: Any, key: jax.Array, hyper: Any) -> Any:
        self.of_conduct = word(key)
        return ()

    def observe(self, seen: Any, key: jax.Array, played: Any) -> Any:
        return jnp.stack([self.of_conduct, word(key)])


def test_no_key_is_drawn_from_twice() -> None:
    """Of environments, guide and skills: ``fold_in(key, i)`` is no key beside those of ``split(key, n)``, but one."""
    config = point_config(**{"skills.horizon": 1, "high_level.num_envs": ENVIRONMENTS})
    seen = []
    guide: Any = SimpleNamespace(
        draw=lambda key, episodes: jnp.full(episodes, word(key)),
        sample=lambda params, key, observation: seen.append(word(key)) or jnp.zeros((ENVIRONMENTS, 2)),
    )
    normaliser, sac = Normaliser(jnp.zeros(2), jnp.ones(2)), SAC(2, 2, config.high_level)
    acting = Acting(config, ShortEnv(), normaliser, 8, RandomWarmUp(0), guide, Recording())
    actor = sac.init(jax.random.key(1), 1.0).actor
    agent = Agent(normaliser, ActionChunks(2), sac, 1.0, {}, actor)
    row = Transition(jnp.zeros(2), jnp.zeros(2), jnp.zeros(()), jnp.zeros(()), jnp.zeros(2))
    state = acting.start(jax.random.key(0), row)
    starts = [*word(state.env_state.info["reset_key"]), state.guided[0]]
    after, _, info = acting.step(state, jax.random.key(2), agent, {}, {"high_level.discount": 0.9})
    assert int(info["ended"]) == ENVIRONMENTS
    drawn = [*word(after.env_state.info["reset_key"]), after.guided[0], *after.seen, *seen]
    for words in (starts, drawn):
        assert len(set(np.asarray(words).tolist())) == len(words)
