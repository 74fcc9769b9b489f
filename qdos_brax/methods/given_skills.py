"""Skills that are not learned but given: those of an exported run, for a high level that begins on them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from flax.errors import FlaxError

import envs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import get, skill_keys
from qdos_brax.data.device import Normaliser
from qdos_brax.errors import UserError
from qdos_brax.population import health
from qdos_brax.population.phase import MemberPhase
from qdos_brax.runs.export import read_export
from qdos_brax.skills.low_level import LowLevelPolicy
from qdos_brax.skills.vae import Segments

# How the high level plays skills, which is its own choice.
FREE = {"skills.latent_box"}


class GivenSkills(NamedTuple):
    """Hold one member's parameters of a low-level policy, and the normaliser of what it sees."""

    params: Any
    normaliser: Normaliser


def read_skills(config: Config, env: Any, low_level: LowLevelPolicy) -> GivenSkills:
    """Return the skills in ``config.skills_file``, which must be of the same task, kind and sizes.

    Args:
        config: of the run that shall begin on them.
        env: its task.
        low_level: its low-level policy.

    Raises:
        UserError: the file cannot be read, or is not of this task, of these sizes or of one member.
    """
    path = Path(str(config.skills_file))
    theirs, found = read_export(path)
    kind, own = METHODS[theirs.method].low_level, METHODS[config.method].low_level
    if (task := _full_name(path, theirs)) != env.spec.full_name:
        raise UserError(f"{path} holds skills of {task}, not of {env.spec.full_name}; give --env {task}")
    if "skills" not in found.arrays:
        raise UserError(f"{path} holds no skills: {theirs.method} has none")
    if kind != own:
        raise UserError(
            f"{path} holds skills of {theirs.method}, which {config.method} cannot play; give --method {theirs.method}"
        )
    if len(theirs.seed) > 1 or found.arrays["normaliser"]["mean"].shape[0] != 1:
        raise UserError(f"{path} holds several members; export one of them with --member N")
    free = FREE if METHODS[config.method].information else FREE | {"skills.alpha"}  # which runs without it set to 0
    for key in skill_keys(kind):
        if key not in free and get(theirs, key) != get(config, key):
            raise UserError(
                f"{key} is {get(config, key)}, and {get(theirs, key)} in {path}, whose skills are learned; leave it out"
            )
    if config.tuning.skills != "frozen" and "correction" in found.arrays["skills"]:
        raise UserError(f"{path} holds skills that are fine-tuned already; play them with tuning.skills=frozen")
    params, normaliser = jax.tree.map(lambda leaf: leaf[0], (found.arrays["skills"], found.arrays["normaliser"]))
    given = GivenSkills(params, Normaliser(**normaliser))
    try:
        jax.eval_shape(lambda: _look(given, low_level, env, config.skills.horizon))
    except (FlaxError, LookupError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its arrays do not fit {theirs.method} on {theirs.env}") from error
    return given


def _full_name(path: Path, config: Config) -> str:
    try:
        return envs.get_spec(config.env).full_name
    except ValueError as error:  # a task that was registered where the skills were learned
        raise UserError(f"{path}: {error}") from error


def _look(given: GivenSkills, low_level: LowLevelPolicy, env: Any, horizon: int) -> Any:
    """Use every part of the low-level policy once, on blanks."""
    observation, action = jnp.zeros((1, env.observation_size)), jnp.zeros((1, low_level.width))
    normal = given.normaliser(observation)
    segments = Segments(jnp.zeros((1, horizon, env.observation_size)), jnp.zeros((1, horizon, env.action_size)))
    latent = low_level.to_latent(given.params, action, normal, 1.0)
    skill = low_level.begin(given.params, latent, normal)
    return low_level.act(given.params, normal, skill, 0), low_level.posterior(given.params, segments, normal)


class GivenSkillsState(struct.PyTreeNode):
    """Hold what every phase carries, [members]; nothing is learned."""

    update: jax.Array
    healthy: jax.Array


class GivenSkillsPhase(MemberPhase):
    """Give skills to the next phases, in place of the phases that would learn them.

    Args:
        given: the skills.
    """

    def __init__(self, given: GivenSkills) -> None:
        super().__init__("skills", "pretrain", 0)
        self._given = given

    def start_member(self, key: jax.Array, hyper: dict[str, jax.Array], shared: None) -> GivenSkillsState:
        """Return a state without updates."""
        return GivenSkillsState(jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def train_member(
        self, state: GivenSkillsState, constants: Any, hyper: dict[str, jax.Array], data: Any
    ) -> tuple[GivenSkillsState, dict[str, jax.Array]]:
        """Return the state: there is nothing to learn."""
        return state, {}

    def finish(self, state: GivenSkillsState, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the skills and their normaliser, the same for every member."""
        members = state.update.shape[0]
        skills = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (members, *leaf.shape)), self._given.params)
        normaliser = self._given.normaliser.repeated(members)
        return artifacts | {"skills": skills, "normaliser": normaliser, health.KEY: state.healthy}
