"""The analysis of a finished run for its page: how it weighs and encodes segments of the data, what its skills do."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax import config as configs
from qdos_brax.analysis.embedding import embedded
from qdos_brax.analysis.episode import measure_episode, place_of_body, play_episode
from qdos_brax.analysis.film import EpisodeRunner, of_member, on_mujoco_c
from qdos_brax.analysis.finished import TrainedRun, evaluation_key
from qdos_brax.data import quality
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import Normaliser
from qdos_brax.data.exchange import exchanged
from qdos_brax.data.segments import episode_last, rows_ahead, segment_starts
from qdos_brax.files import write_arrays
from qdos_brax.methods.learners_view import learners_observations
from qdos_brax.methods.low_level_kinds import make_low_level
from qdos_brax.skills.temperature import member_temperature
from qdos_brax.skills.vae import Segments
from qdos_brax.skills.weights import advantage_weights

_SEGMENTS = 600
_MEMBERS = 3  # the most members that are analysed: the first seed of each of the first settings
_GRID = 5  # skills along each of the two main directions of the latents
_SPREAD = 2.0  # how far the grid extends along them, in standard deviations
_BETWEEN = 9  # skills on the line from one to another
_HELD = 3  # the time that a skill is kept for on the map, in lengths of a segment
_SEED = 0  # of the sample of segments

Arrays = dict[str, np.ndarray]


def look_inside(trained: TrainedRun, dataset: Dataset, out: Path) -> None:
    """Analyse a finished run and write what was found to ``out``.

    Arrays that the task, the method or the machine (without OpenGL) cannot give are left out.

    The arrays of ``out``, where m is the number of an analysed member:
        members: int[M], the numbers of the analysed members.
        gain, return, quality: [n], of random segments of the data: the decrease of the shortest path to the goal,
            undiscounted return, index into ``quality_names``.
        quality_names: str[..], the names in ``data.quality.QUALITY`` by their codes.
        part, part_names: int[n], str[..], which part of the task changed in each segment (``changed_parts``), of tasks
            that have parts.
        m/weight: float[n], the weight of each segment (methods that weigh them).
        m/latent, m/tsne, m/tsne_episode: float[n, z], float[n, 2], float[K, 2], the posterior's means, and where t-SNE
            lays them and the latents of the episode below (methods that infer skills from segments).
        m/grid, m/between: float[k, T, 2], the positions from the task's start on, under skills along the two
            main directions of the latents, and under skills between the latents of two segments.
        m/path, m/left, m/parts, m/latents: float[T, 2], float[T], bool[T, P], float[K, z]: an evaluation episode:
            positions, the distance left to the goal, which parts of the task are done, the latent of each decision.
        m/frames, m/frame_steps: uint8[F, height, width, 3], int[F], pictures of the scene at some of its steps.
        m/film, m/film_speed: uint8[bytes], float[], the episode as a WebP, and how many times as fast it plays.
        goal, walls: float[2], float[W, 2], the goal and the centres of the wall cells.

    Args:
        trained: the run.
        dataset: its data, as logged.
        out: the file, ending in .npz.

    Raises:
        UserError: the file cannot be written.
    """
    trained = on_mujoco_c(trained)
    sample = _sample(trained, dataset)
    members = _first_seeds(trained)
    arrays: Arrays = {"members": np.asarray(members), **_place(trained.env), **_truth(trained, sample)}
    latents, runner = _LatentView(trained, sample), EpisodeRunner(trained)
    with ThreadPoolExecutor(1) as beside:  # t-SNE on one core while episodes are played and drawn on another
        places, episodes = {}, {}
        for member in members:  # all are played first, so that t-SNE has the most to do beside the drawing
            view, episodes[member] = latents.of(member), play_episode(trained, runner, member)
            if "latent" in view:
                places[member] = beside.submit(embedded, view["latent"], episodes[member].latents)
            arrays |= _of_member(member, _weights(trained, member, sample) | view)
        for member, episode in episodes.items():
            arrays |= _of_member(member, measure_episode(trained.env, episode, trained.config.skills.horizon))
        for member, embedding in places.items():
            arrays |= _of_member(member, embedding.result())
    write_arrays(out, arrays)


def _of_member(member: int, arrays: Arrays) -> Arrays:
    """Return a member's arrays by the names that they have in the file."""
    return {f"{member}/{name}": array for name, array in arrays.items()}


class _Sample(NamedTuple):
    """Hold a sample of the segments of a run's data.

    Attributes:
        dataset: the data that the run learned from: its weights are of these rows.
        chosen: int[n], the indices of the segments among all segments.
        rows: int[n, H], their rows.
    """

    dataset: Dataset
    chosen: np.ndarray
    rows: np.ndarray


def _sample(trained: TrainedRun, dataset: Dataset) -> _Sample:
    """Draw random segments of what the run learned from, the same ones for every method on the same data."""
    horizon, exchange = trained.config.skills.horizon, trained.config.exchange
    dataset = exchanged(dataset, trained.env, exchange.share, exchange.seed)
    starts = segment_starts(dataset.ends, horizon)
    chosen = np.sort(np.random.default_rng(_SEED).choice(len(starts), min(_SEGMENTS, len(starts)), replace=False))
    return _Sample(dataset, chosen, starts[chosen][:, None] + np.arange(horizon))


def _first_seeds(trained: TrainedRun) -> list[int]:
    """Return the first member of each of the first settings."""
    members = configs.members(trained.config)
    settings = [tuple(value for key, value in member.items() if key != "seed") for member in members]
    return sorted({settings.index(setting) for setting in settings})[:_MEMBERS]


def _place(env: Any) -> Arrays:
    floor = env.floor_map()
    if floor is None:
        return {}
    return {"goal": np.asarray(floor.goal, np.float32), "walls": np.asarray(floor.walls, np.float32)}


# --- Segments --------------------------------------------------------------------------------------------------


def _truth(trained: TrainedRun, sample: _Sample) -> Arrays:
    """Return what is known of the segments without a learner."""
    dataset, starts, horizon = sample.dataset, sample.rows[:, 0], trained.config.skills.horizon
    found: Arrays = {"return": dataset.rewards[sample.rows].sum(axis=1)}
    if dataset.qpos is not None:
        gain = quality.progress(trained.env, dataset, starts, horizon)
        if gain is not None:
            found["gain"] = np.where(np.isfinite(gain), gain, np.nan).astype(np.float32)
    changed = quality.changed_parts(trained.env, dataset, starts, horizon)
    if changed is not None:
        found["part"], found["part_names"] = changed
    if dataset.quality is not None:
        found["quality"] = dataset.quality[starts]
        found["quality_names"] = np.asarray(sorted(quality.QUALITY, key=quality.QUALITY.__getitem__))
    return found


def _weights(trained: TrainedRun, member: int, sample: _Sample) -> Arrays:
    if "advantage" not in trained.artifacts:
        return {}
    advantage, hyper = trained.artifacts["advantage"][member], {key: x[member] for key, x in trained.hyper.items()}
    weights = advantage_weights(advantage, member_temperature(advantage, hyper), hyper["skills.weight_clip"])
    return {"weight": np.asarray(weights)[sample.chosen]}


class _LatentView:
    """Compute latents of the segments and the paths of skills; compiled once for all members.

    Args:
        trained: the run.
        sample: the segments.
    """

    def __init__(self, trained: TrainedRun, sample: _Sample) -> None:
        horizon, dataset, rows = trained.config.skills.horizon, sample.dataset, sample.rows
        # Of the sample's rows alone: the whole data on the device a second time would be the run's peak of memory.
        low_level = make_low_level(trained.config, trained.env)
        starts, last = jnp.asarray(rows[:, 0]), jnp.asarray(episode_last(dataset.ends))
        after = np.asarray(rows_ahead(starts, last, low_level.reach or horizon))
        logged = (dataset.observations[rows], dataset.next_observations[after])
        taken: Any = [learners_observations(trained.env, observations) for observations in logged]
        # All members have one normaliser. In NumPy, for which nothing is compiled.
        own = jax.tree.map(lambda leaf: np.asarray(leaf)[0], trained.artifacts["normaliser"])
        observations, self._after = map(Normaliser(**own), taken)
        self._trained = trained
        self._segments = Segments(observations, jnp.asarray(dataset.actions[rows]))
        self._steps = min(_HELD * horizon, trained.env.episode_length)
        self._posterior = jax.jit(low_level.posterior)
        self._play = jax.jit(jax.vmap(self._path, in_axes=(None, None, 0)))

    def of(self, member: int) -> Arrays:
        """Return the arrays of a member; none for methods without skills."""
        if "skills" not in self._trained.artifacts or self._trained.config.skills.horizon == 1:
            return {}
        artifacts, hyper = of_member(self._trained, member)
        latents = np.asarray(self._posterior(artifacts["skills"], self._segments, self._after).mean)
        if not np.isfinite(latents).all():  # the member was frozen
            return {}
        if self._trained.env.floor_map() is None:
            return {"latent": latents}
        grid, between = _grid(latents), _between(latents)
        paths = np.asarray(self._play(artifacts, hyper, np.concatenate([grid, between])), np.float32)
        return {"latent": latents, "grid": paths[: len(grid)], "between": paths[len(grid) :]}

    def _path(self, artifacts: Any, hyper: Any, latent: jax.Array) -> jax.Array:
        """Return float[T + 1, 2], the positions from the start on while one latent is begun again and again."""
        env = self._trained.env
        agent: Any = self._trained.agent(artifacts, hyper)  # of both levels, where there are skills
        horizon = self._trained.config.skills.horizon

        def step(carry: tuple[Any, jax.Array], t: jax.Array) -> tuple[Any, jax.Array]:
            state, skill = carry
            skill = jnp.where(t % horizon == 0, agent.begin(state.obs, latent), skill)
            state = env.step(state, agent.play(state.obs, skill, t % horizon))
            return (state, skill), place_of_body(env, state.pipeline_state.qpos)

        start = env.reset(evaluation_key())
        _, path = jax.lax.scan(step, (start, agent.begin(start.obs, latent)), jnp.arange(self._steps))
        return jnp.concatenate([place_of_body(env, start.pipeline_state.qpos)[None], path])


def _main_directions(latents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (mean[z], axes[2, z]): the two directions of largest variance, as long as their standard deviation."""
    mean = latents.mean(axis=0)
    _, sizes, axes = np.linalg.svd(latents - mean, full_matrices=False)
    return mean, axes[:2] * sizes[:2, None] / np.sqrt(len(latents))


def _grid(latents: np.ndarray) -> np.ndarray:
    """Return float[_GRID^2, z], latents on a grid along the two main directions, row by row."""
    mean, axes = _main_directions(latents)
    ticks = np.linspace(-_SPREAD, _SPREAD, _GRID)
    return np.asarray([mean + np.array([x, y])[: len(axes)] @ axes for y in ticks for x in ticks], np.float32)


def _between(latents: np.ndarray) -> np.ndarray:
    """Return float[_BETWEEN, z], on a line between the latents of two segments far apart in the main direction."""
    mean, axes = _main_directions(latents)
    order = np.argsort((latents - mean) @ axes[0])
    first, last = latents[order[len(order) // 20]], latents[order[-1 - len(order) // 20]]
    share = np.linspace(0, 1, _BETWEEN)[:, None]
    return np.asarray((1 - share) * first + share * last, np.float32)
