"""The value phase by default: how far every logged state is from success, on a graph of logged states."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.config import SkillsConfig, ValuesConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.population.members import Population
from qdos_brax.population.phase import MemberPhase
from qdos_brax.skills.slow_features import fit_slow_features
from qdos_brax.skills.state_graph import costs_to_go, step_costs
from qdos_brax.skills.value_phase import segment_advantages
from qdos_brax.skills.weights import scaled_advantage


class GraphPhase(MemberPhase):
    """Find shortest paths on the host, in one chunk; nothing is random, so all members share what it finds.

    Args:
        values: how the graph is made.
        skills: length of a segment, and scale of its advantage.
        ends: bool[N], the last row of each episode.
    """

    def __init__(self, values: ValuesConfig, skills: SkillsConfig, ends: np.ndarray) -> None:
        super().__init__("values", "pretrain", 1)
        self._values, self._skills, self._ends = values, skills, np.asarray(ends, bool)

    def bind(self, population: Population, data: DeviceData) -> None:
        """Keep the data and the number of members; there is nothing to compile."""
        self.data, self._members = data, population.members

    def init(self, key: jax.Array, artifacts: dict[str, Any]) -> tuple[jax.Array, dict[str, Any]]:
        """Return float32[members, N], the value of every logged state, yet to be found, and no constants."""
        return jnp.asarray(np.zeros((self._members, len(self.data.rewards)), np.float32)), {}

    def chunk(self, state: jax.Array, constants: dict[str, Any]) -> tuple[jax.Array, dict[str, np.ndarray]]:
        """Return the values: minus the cost of the way to success."""
        costs = graph_costs(self._values, self._skills.horizon, self.data, self._ends)
        found = {"update": np.ones(self._members), "cost_to_go": np.full(self._members, costs.mean())}
        return jnp.asarray(np.tile(-costs, (self._members, 1))), found

    def compile(self, state: Any, constants: Any) -> None:
        """Compile nothing: the search is the host's."""

    def working_bytes(self, state: Any, constants: Any) -> int:
        """Return 0: the search is the host's."""
        return 0

    def finish(self, state: jax.Array, artifacts: dict[str, Any]) -> dict[str, Any]:
        """Return the artifacts with the scaled advantage of every segment, float32[members, S].

        Data goes on after a success, and so does this task: to stay there costs nothing, to leave it is a loss. Where
        an episode ends, the value after its last row is that row's, for the state behind it is no row of the data.
        """
        costs = step_costs(np.asarray(self.data.rewards)).astype(np.float32)
        return artifacts | {"advantage": self._advantages(state, costs, self._ends, self.data)}

    @partial(jax.jit, static_argnums=0)
    def _advantages(self, state: jax.Array, costs: jax.Array, ends: jax.Array, data: DeviceData) -> jax.Array:
        """Return the scaled advantage of every segment, [members, S]."""
        value = state[0]
        following = jnp.where(ends, value, jnp.roll(value, -1))
        endless = data.replace(rewards=-costs, masks=jnp.ones_like(costs))
        advantage = segment_advantages(value, following, endless, self._skills.horizon, jnp.ones(()))
        return jnp.tile(scaled_advantage(advantage, self._skills.advantage_scale), (self._members, 1))


def graph_costs(values: ValuesConfig, horizon: int, data: DeviceData, ends: np.ndarray) -> np.ndarray:
    """Return float32[N], the cost of the way to success from every logged state; all 0, and a line says so, if
    there is none.

    Args:
        values: how the graph is made.
        horizon: steps of a segment.
        data: the data set.
        ends: bool[N], the last row of each episode.
    """
    observations, next_observations = np.asarray(data.observations), np.asarray(data.next_observations)
    features = fit_slow_features(observations, next_observations, np.asarray(data.starts), horizon, values.slowness)
    costs = step_costs(np.asarray(data.rewards))
    if costs.min() > 0:
        what = "no success in the data" if np.all(data.masks) else "rewards do not tell success apart"
        print(
            f"values    {what}, every reward is {data.rewards[0]:g}: all segments will count the same",
            file=sys.stderr,
            flush=True,
        )
    return costs_to_go(
        features(observations),
        costs,
        ends,
        max_nodes=values.max_nodes,
        neighbours=values.neighbours,
        jump_cost=horizon * values.jump_cost,
    )
