"""Measure the ceiling of a skill space, without RL: ``python benchmarks/skills.py RUN [RUN ..] --out FILE``.

Plays draws from the skill prior in the simulator, of every member of a finished run:

- from logged states, some draws each: progress of a macro step in mean and of the best draw, and how far the outcomes
  lie from their mean;
- R2 of the latent, as a linear map of the start's observation alone, and of that and the outcome, and R2 of the outcome
  from the observation alone, and from that and the latent: each second beyond its first is what z says of what happens;
- the share of states in which skills have to get at something and do: in mazes states at a wall, less than WALL away,
  from which WAY_SECONDS of skills lead more than AWAY away, each the draw that leads furthest; for an arm all states,
  where a draw moves a thing by MOVED; beside it ("_log") the share of the same states from which the log itself did;
- random skills, one after the other: success and best score of whole episodes;
- the oracle: success, score and steps of episodes in which the draw of most progress is played, by the truth and by
  what training knows (V, the cost to go of the nearest logged states on the graph that weighs segments too);
- the search, which looks further ahead than one skill (``benchmarks/skill_search.py``): success, score, steps.

In mazes progress is the true decrease of the shortest path to the goal, which training never sees, and an outcome is
where the body got, as seen from its start. With a ball the path is the body's to where it can push the ball its way,
and twice the ball's. An arm has no such truth: progress is that of V, and an outcome is the change of its features.

Prints a table and writes CSV.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from regression import r2
from skill_search import searches
from skill_truths import ArmTruth, GraphValues, Truth, truth_of
from table import aligned, write_rows

from envs.brax_base import State
from qdos_brax import config as configs
from qdos_brax.analysis.conclusion import read_finished
from qdos_brax.analysis.film import of_member, on_mujoco_c
from qdos_brax.analysis.finished import TrainedRun
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.segments import episode_last
from qdos_brax.errors import guarded
from qdos_brax.methods.learners_view import run_dataset
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.jax_setup import prepare_jax


class Skills:
    """Play draws from one member's skill prior.

    Args:
        trained: the run, on MuJoCo C.
        member: its number.
        draws: skills tried from each state.
    """

    def __init__(self, trained: TrainedRun, member: int, draws: int) -> None:
        artifacts, hyper = of_member(trained, member)
        self.env, self.horizon, self._draws = trained.env, trained.config.skills.horizon, draws
        self._agent: Any = trained.agent(artifacts, hyper)
        self.play = jax.jit(self._play)
        self.reset_to = jax.jit(jax.vmap(lambda qpos, qvel, extra: self.env.reset_to(qpos, qvel, extra=extra)))

    def _play(self, states: State, key: jax.Array) -> dict[str, Any]:
        """Return what each draw leads to from states[S]: [draws, S] of the end (a State), success, score, steps, z."""
        keys = jax.random.split(key, (self._draws, len(states.reward)))
        return jax.vmap(jax.vmap(self._macro_step), in_axes=(None, 0))(states, keys)

    def _macro_step(self, start: State, key: jax.Array) -> dict[str, Any]:
        agent, env = self._agent, self.env
        normal = agent.normaliser(start.obs)
        action = agent.low_level.first(agent.skills, key, normal, agent.box)
        skill = agent.skill(action, normal)

        def reached(state: State) -> jax.Array:
            physics = state.pipeline_state
            return env.success(physics.qpos, state.info["goal"], physics.extra)

        def step(carry: Any, index: jax.Array) -> tuple[Any, jax.Array]:
            state, success, steps = carry
            new = env.step(state, agent.play(state.obs, skill, index))
            state = jax.tree.map(lambda a, b: jnp.where(success, a, b), state, new)
            return (state, success | reached(state), steps + ~success), state.metrics.get("score", success)

        first = (start, reached(start), jnp.zeros((), jnp.int32))
        (end, success, steps), scores = jax.lax.scan(step, first, jnp.arange(self.horizon))
        latent = skill[: agent.low_level.width]
        return {"end": end, "success": success, "score": scores.max(), "steps": steps, "latent": latent}


def from_logged_states(skills: Skills, truth: Truth, dataset: Dataset, states: int) -> dict[str, float]:
    """Return the measures that need no episodes."""
    rows = np.random.default_rng(0).choice(len(dataset.qpos), states, replace=False)
    before = skills.reset_to(dataset.qpos[rows], dataset.qvel[rows], extra_of(skills.env, dataset, rows))
    found = skills.play(before, jax.random.key(1))
    gain = truth.left(before) - truth.left(found["end"])
    outcome = truth.outcome(before, found["end"])
    z = np.asarray(found["latent"]).reshape(-1, found["latent"].shape[-1])
    seen = np.tile(dataset.observations[rows], (len(outcome), 1))
    happened = outcome.reshape(len(z), -1)
    # What an outcome says of z depends on the state, and what z says of it.
    turned = (happened[:, :, None] * seen[:, None, :]).reshape(len(z), -1)
    played = (z[:, :, None] * seen[:, None, :]).reshape(len(z), -1)
    return {
        "progress_mean": float(gain.mean()),
        "progress_best": float(gain.max(axis=0).mean()),
        "spread": float(np.sqrt(outcome.var(axis=0).sum(axis=-1)).mean()),
        "r2_state": r2(z, seen),
        "r2_state_and_outcome": r2(z, seen, happened, turned),
        "r2_outcome_of_state": r2(happened, seen),
        "r2_outcome_of_state_and_latent": r2(happened, seen, z, played),
        truth.reach_name: share_reached(skills, truth, before, found),
        f"{truth.reach_name}_log": share_reached_by_log(skills, truth, dataset, before, rows),
    }


def extra_of(env: Any, dataset: Dataset, rows: np.ndarray) -> np.ndarray:
    """Return what a state of each row has besides positions and velocities, int32[S, extra]."""
    return np.zeros((len(rows), env.extra_size), np.int32) if dataset.extra is None else dataset.extra[rows]


def ends_of(found: Any, draw: np.ndarray) -> State:
    """Return the states[S] to which ``draw[S]``, one of the draws for each state, leads."""
    every = np.arange(len(draw))
    return jax.tree.map(lambda leaf: leaf[draw, every], found["end"])


def share_reached(skills: Skills, truth: Truth, before: State, found: Any) -> float:
    """Return the share of states, of those where it counts, from which skills get at what there is to get at.

    Args:
        found: what a first skill's draws lead to from the states ``before``. Each further one of ``reach_steps`` begins
            where the draw led that got furthest.
    """
    reached = truth.reach(before, found["end"]).any(axis=0)
    for turn in range(1, truth.reach_steps // skills.horizon):
        furthest = np.linalg.norm(truth.outcome(before, found["end"]), axis=-1).argmax(axis=0)
        found = skills.play(ends_of(found, furthest), jax.random.key(1 + turn))
        reached |= truth.reach(before, found["end"]).any(axis=0)
    return float(reached.mean())


def share_reached_by_log(skills: Skills, truth: Truth, dataset: Dataset, before: State, rows: np.ndarray) -> float:
    """Return the share of states, of those where it counts, from which the log got at it in as many steps.

    Args:
        before: the states.
        rows: int[S], their rows; an episode that ends sooner counts with its last.
    """
    later = np.minimum(rows + max(truth.reach_steps, skills.horizon), episode_last(dataset.ends)[rows])
    after = skills.reset_to(dataset.qpos[later], dataset.qvel[later], extra_of(skills.env, dataset, later))
    return float(truth.reach(before, jax.tree.map(lambda leaf: leaf[None], after)).mean())


class Episodes(NamedTuple):
    """Hold how episodes went, [episodes] each."""

    success: np.ndarray
    score: np.ndarray
    steps: np.ndarray


def play_episodes(skills: Skills, choose: Callable[[State, Any], np.ndarray], episodes: int) -> Episodes:
    """Play episodes in which ``choose`` picks one of the draws of each macro step: (before, found) -> int[episodes]."""
    env = skills.env
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(7), episodes))
    steps, score, done = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes, bool)
    for decision in range(env.episode_length):
        found = skills.play(states, jax.random.key(decision))
        best = np.asarray(choose(states, found)), np.arange(episodes)
        steps += np.where(done, 0, np.asarray(found["steps"])[best])
        score = np.where(done, score, np.maximum(score, np.asarray(found["score"])[best]))
        done = done | (np.asarray(found["success"])[best] & (steps <= env.episode_length))
        states = ends_of(found, best[0])
        if done.all() or steps[~done].min() >= env.episode_length:
            break
    return Episodes(done, np.where(done, 1.0, score), steps)


def whole_episodes(skills: Skills, truth: Truth, values: GraphValues, episodes: int) -> dict[str, float]:
    """Return how random skills and the two oracles do; of an arm they are one."""
    at_random = play_episodes(skills, lambda before, _: np.zeros(len(before.reward), int), episodes)
    found = {"random_success": float(at_random.success.mean()), "random_score": float(at_random.score.mean())}
    found |= oracle_episodes("oracle", skills, truth.left, episodes)
    return found if isinstance(truth, ArmTruth) else found | oracle_episodes("v_oracle", skills, values.left, episodes)


def oracle_episodes(name: str, skills: Skills, left: Callable[[State], np.ndarray], episodes: int) -> dict[str, float]:
    """Return how the choice of the draw after which least is left does, under the names that begin with ``name``."""

    def most_progress(before: State, found: Any) -> np.ndarray:
        return np.where(np.asarray(found["success"]), np.inf, left(before) - left(found["end"])).argmax(axis=0)

    oracle = play_episodes(skills, most_progress, episodes)
    return {
        f"{name}_success": float(oracle.success.mean()),
        f"{name}_score": float(oracle.score.mean()),
        f"{name}_steps": float(oracle.steps[oracle.success].mean()) if oracle.success.any() else np.nan,
    }


def measure(run: Path, draws: int, states: int, episodes: int, number: int) -> list[dict[str, Any]]:
    """Return one row per member of a finished run."""
    trained, dataset = read_finished(RunFolder.open(run))
    trained = on_mujoco_c(trained)
    config, skills = trained.config, trained.config.skills
    run_row = {"task": config.env, "method": config.method, "view": skills.view, "horizon": skills.horizon}
    about = [run_row | settings for settings in configs.members(config)]
    return measure_members(trained, dataset, about, draws, states, episodes, number)


def measure_members(
    trained: TrainedRun,
    dataset: Dataset,
    about: Sequence[dict[str, Any]],
    draws: int,
    states: int,
    episodes: int = 0,
    number: int = 0,
) -> list[dict[str, Any]]:
    """Return one row per member, which begins with what is known ``about`` it.

    Args:
        trained: the run, on MuJoCo C.
        dataset: its data, as logged.
        about: for each member, the row's first columns.
        draws: skills tried in each state.
        states: logged states.
        episodes: of random skills and of the oracle; 0 plays none.
        number: of searches; 0 makes none.
    """
    dataset = run_dataset(trained.config, trained.env, dataset)
    values = GraphValues(trained, dataset)
    truth, rows = truth_of(trained, values), []
    for member, known in enumerate(about):
        started = time.perf_counter()
        skills = Skills(trained, member, draws)
        found = from_logged_states(skills, truth, dataset, states)
        found |= whole_episodes(skills, truth, values, episodes) if episodes else {}
        found |= searches(Skills(trained, member, 1), truth.left, number) if number else {}
        rows.append(known | found | {"seconds": time.perf_counter() - started})
        print(f"{member + 1} of {len(about)} members measured, {rows[-1]['seconds']:.0f} s", flush=True)
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a line per measure and a column per member: there are few members and many measures."""

    def cell(value: Any) -> str:
        return f"{value:.3f}" if isinstance(value, float) else str(value)

    names = dict.fromkeys(name for row in rows for name in row)
    return aligned([[name, *(cell(row.get(name, "")) for row in rows)] for name in names])


def main() -> None:
    """Measure the runs named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a finished run with skills")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="the CSV to write")
    parser.add_argument("--draws", type=int, default=16, help="skills drawn in each state (default 16)")
    parser.add_argument("--states", type=int, default=500, help="logged states (default 500)")
    parser.add_argument("--episodes", type=int, default=16, help="episodes of the oracle (default 16)")
    parser.add_argument("--searches", type=int, default=2, help="searches of 64 episodes each (default 2)")
    args = parser.parse_args()
    prepare_jax()
    rows = [row for run in args.runs for row in measure(run, args.draws, args.states, args.episodes, args.searches)]
    write_rows(args.out, rows)
    print(table(rows), end="")


if __name__ == "__main__":
    raise SystemExit(guarded(main))
