"""Trains an expert with SAC on MuJoCo C: ``python -m qdos_brax.collection.experts.train EXPERT --out DIR --steps N``.

One jitted program steps all environments, fills the replay and makes the updates. The same command goes on where it
was stopped, exactly; DIR holds ``checkpoints/``, the weights ``EXPERT.npz``, the curve ``EXPERT.csv``, and
``EXPERT-learner.npz``: networks and optimiser without the replay, small enough to keep; ``--learner`` starts from it.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.tasks import TASKS, Life, Task
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.sac import SAC, Batch, SACHyper, SACState
from qdos_brax.nn.optim import polyak
from qdos_brax.runs.checkpoint import CheckpointStore, Position, choose

EVALUATION_STEPS = 250
INITIAL_TEMPERATURE = 0.1


@dataclass(frozen=True)
class Sizes:
    """Static sizes of the training.

    Attributes:
        num_envs: environments stepped at once.
        updates_per_step: critic updates per step of all environments.
        actor_every: critic updates per actor update.
        batch_size: rows per update.
        hidden: widths of actor and critics.
        capacity: rows of the replay.
        random_steps: first rows, with random actions and without updates.
        steps_per_chunk: steps of all environments per call of the program.
        average_rate: per step of all environments, at which the policy that is kept follows the one that learns.
    """

    num_envs: int = 64
    updates_per_step: int = 16
    actor_every: int = 2
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    capacity: int = 500_000
    random_steps: int = 5_000
    steps_per_chunk: int = 50
    average_rate: float = 0.002


class TrainState(struct.PyTreeNode):
    """Everything the loop carries; ``average`` is the running mean of the actor, steadier than any one of them."""

    sac: SACState
    average: Any
    replay: replay_buffer.Replay
    lives: Life
    key: jax.Array


class Trainer:
    """The program: ``init``, ``chunk`` and ``evaluate``.

    Args:
        task: what is learned.
        sizes: static sizes.
    """

    def __init__(self, task: Task, sizes: Sizes) -> None:
        self.task, self.sizes = task, sizes
        self.sac = SAC(task.observation_dim, task.action_dim, sizes.hidden, 2, 2, entropy_backup=True)
        self.hyper = SACHyper(
            learning_rate=3e-4, discount=task.discount, target_rate=0.005, target_entropy=-task.action_dim / 2
        )

    def init(self, key: jax.Array, learner: SACState | None = None) -> TrainState:
        """New lives, an empty replay, and ``learner``, or fresh networks."""
        sac_key, reset_key, clock_key, key = jax.random.split(key, 4)
        n = self.sizes.num_envs
        lives = jax.vmap(self.task.reset)(jax.random.split(reset_key, n))
        clocks = jax.random.randint(clock_key, (n,), 0, self.task.life_steps)  # so that they do not all end at once
        observation = jnp.zeros(self.task.observation_dim)
        row = Batch(observation, jnp.zeros(self.task.action_dim), jnp.zeros(()), jnp.zeros(()), observation)
        sac = self.sac.init(sac_key, INITIAL_TEMPERATURE) if learner is None else learner
        return TrainState(
            sac=sac,
            average=jax.tree.map(jnp.copy, sac.actor),
            replay=replay_buffer.create(row, self.sizes.capacity),
            lives=lives.replace(clock=clocks),
            key=key,
        )

    @partial(jax.jit, static_argnums=(0, 2, 3), donate_argnums=1)
    def chunk(self, state: TrainState, random_actions: bool, learns: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        """``steps_per_chunk`` steps of every environment; means of what was measured."""

        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            state, info = self._environment_step(state, random_actions)
            if not learns:
                return state, info
            count = self.sizes.updates_per_step // self.sizes.actor_every
            keys = jax.random.split(state.key, count + 1)
            sac, losses = jax.lax.scan(partial(self._updates, state.replay), state.sac, keys[1:])
            average = polyak(state.average, sac.actor, self.sizes.average_rate)
            state = state.replace(sac=sac, average=average, key=keys[0])
            return state, {**info, **jax.tree.map(jnp.mean, losses)}

        state, info = jax.lax.scan(step, state, length=self.sizes.steps_per_chunk)
        return state, jax.tree.map(jnp.mean, info)

    def _environment_step(self, state: TrainState, random_actions: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        act_key, live_key, key = jax.random.split(state.key, 3)
        observation = jax.vmap(self.task.observe)(state.lives)
        if random_actions:
            action = jax.random.uniform(act_key, (self.sizes.num_envs, self.task.action_dim), minval=-1.0)
        else:
            action = self.sac.act(state.sac.actor, act_key, observation)
        row, lives, info = self._live(state.lives, observation, action, live_key)
        return state.replace(replay=replay_buffer.insert(state.replay, row), lives=lives, key=key), info

    def _live(
        self, lives: Life, observation: jax.Array, action: jax.Array, key: jax.Array
    ) -> tuple[Batch, Life, dict[str, jax.Array]]:
        """One control step of all lives: the rows it gives, the lives that follow, means of what was measured."""
        n = action.shape[0]
        reset_key, turn_key, turn_to_key, shake_key = jax.random.split(key, 4)
        joints = jax.vmap(self.task.joints)(lives, action)
        joints = jnp.clip(joints + self.task.shake * jax.random.normal(shake_key, joints.shape), -1.0, 1.0)
        after = jax.vmap(self.task.engine.step)(lives.pipeline, joints)
        verdict = jax.vmap(self.task.judge)(lives, joints, after)
        next_observation = jax.vmap(self.task.observe)(lives.replace(pipeline=after))
        row = Batch(observation, action, verdict.reward, verdict.alive.astype(jnp.float32), next_observation)

        turns = jax.random.uniform(turn_key, (n, 1)) < 1 / self.task.turn_every
        directions = jax.vmap(random_direction)(jax.random.split(turn_to_key, n))
        onward = Life(after, jnp.where(turns, directions, lives.direction), lives.clock + 1)
        fresh = jax.vmap(self.task.reset)(jax.random.split(reset_key, n))
        goes_on = verdict.alive & ~verdict.lost & (onward.clock < self.task.life_steps)
        info = {
            "reward": verdict.reward,
            "falls_per_1000": 1000.0 * (1.0 - verdict.alive),
            "lost_per_1000": 1000.0 * verdict.lost,
            **verdict.measures,
        }
        return row, _by_row(goes_on, onward, fresh), jax.tree.map(jnp.mean, info)

    def _updates(
        self, replay: replay_buffer.Replay, sac: SACState, key: jax.Array
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """``actor_every`` critic updates and one of the actor."""
        info: dict[str, jax.Array] = {}
        for sub_key in jax.random.split(key, self.sizes.actor_every):
            sample_key, mirror_key, critic_key, actor_key = jax.random.split(sub_key, 4)
            batch = replay_buffer.sample(replay, sample_key, self.sizes.batch_size)
            straight = jax.random.bernoulli(mirror_key, shape=batch.reward.shape)
            batch = _by_row(straight, batch, self.task.mirror(batch))
            sac, info = self.sac.update_critic(sac, batch, critic_key, self.hyper)
        sac, actor_info = self.sac.update_actor(sac, batch.observation, actor_key, self.hyper)
        return sac, {**info, **actor_info}

    @partial(jax.jit, static_argnums=0)
    def evaluate(self, actor: Any, key: jax.Array) -> dict[str, jax.Array]:
        """Means over EVALUATION_STEPS control steps of every environment, under the deterministic policy."""

        def step(lives: Life, key: jax.Array) -> tuple[Life, dict[str, jax.Array]]:
            observation = jax.vmap(self.task.observe)(lives)
            _, lives, info = self._live(lives, observation, self.sac.mode(actor, observation), key)
            return lives, info

        reset_key, key = jax.random.split(key)
        lives = jax.vmap(self.task.reset)(jax.random.split(reset_key, self.sizes.num_envs))
        info = jax.lax.scan(step, lives, jax.random.split(key, EVALUATION_STEPS))[1]
        return jax.tree.map(jnp.mean, info)


def _by_row(chosen: jax.Array, these: Any, those: Any) -> Any:
    """Rows of ``these`` where ``chosen``[n], of ``those`` elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b), these, those)


class Training:
    """A training in a folder: goes on where the folder says.

    Args:
        trainer: the program.
        folder: see the module.
        seed: of everything random.
        learner: a learner's file to start from, or None.
        chunks_per_save: chunks between two checkpoints, at which the policy is evaluated too.
    """

    def __init__(
        self, trainer: Trainer, folder: Path, seed: int, learner: Path | None = None, chunks_per_save: int = 20
    ) -> None:
        self.trainer, self.folder, self.seed, self.chunks_per_save = trainer, folder, seed, chunks_per_save
        self.name, self.sizes = trainer.task.name, trainer.sizes
        folder.mkdir(parents=True, exist_ok=True)
        described = {"expert": self.name, "seed": seed, "learner": str(learner), **asdict(self.sizes)}
        config = hashlib.sha256(json.dumps(described).encode()).hexdigest()
        self.store = CheckpointStore(folder / "checkpoints", config)
        train_key, self.evaluate_key = jax.random.split(jax.random.key(seed))
        given = None if learner is None else read_learner(learner, trainer)
        self.is_continued = learner is not None
        self.state = trainer.init(train_key, given)
        self.chunks_done, self.seconds = 0, 0.0
        self.rows: list[dict[str, float]] = []
        choose(self.store, self._restore, print)

    def run(self, steps: int, command: str = "") -> None:
        """Goes on until ``steps`` environment steps are made; saves on the way.

        Args:
            steps: environment steps since the very start.
            command: how it was started, for the weights' header.
        """
        per_chunk = self.sizes.num_envs * self.sizes.steps_per_chunk
        last = -(-steps // per_chunk)
        while self.chunks_done < last:
            began = time.monotonic()
            begins = self.chunks_done * per_chunk < self.sizes.random_steps
            self.state, info = self.trainer.chunk(self.state, begins and not self.is_continued, not begins)
            info = {name: float(value) for name, value in info.items()}
            self.seconds += time.monotonic() - began
            self.chunks_done += 1
            row: dict[str, float] = {"steps": self.chunks_done * per_chunk, "seconds": round(self.seconds)}
            print(" ".join(f"{key}={value:.4g}" for key, value in (row | info).items()), flush=True)
            if self.chunks_done % self.chunks_per_save == 0 or self.chunks_done == last:
                self._save(row, command)

    def _save(self, row: dict[str, float], command: str) -> None:
        reached = self.trainer.evaluate(self.state.average, self.evaluate_key)
        row = row | {name: float(f"{float(value):.5g}") for name, value in reached.items()}
        self.rows.append(row)
        print("evaluation " + json.dumps(row), flush=True)
        header = {"command": command, "seed": self.seed, **row}
        actor = policies.Actor(self.sizes.hidden, self.trainer.task.action_dim, self.state.average, header)
        policies.write_actor(self.folder / f"{self.name}.npz", actor)
        write_learner(self.folder / f"{self.name}-learner.npz", self.state.sac)
        write_text(self.folder / f"{self.name}.csv", _table(self.rows))
        position = Position(0, self.chunks_done, len(self.rows), tuple(row), {"train": self.seconds})
        self.store.save(position, self.state)

    def _restore(self, name: str) -> None:
        position = self.store.position(name)
        self.state = self.store.restore(name, self.state)
        self.chunks_done, self.seconds = position.chunk, position.wall_seconds["train"]
        with open(self.folder / f"{self.name}.csv", encoding="utf-8") as file:
            rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
        self.rows = rows[: position.rows]


def _table(rows: list[dict[str, float]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_learner(path: Path, sac: SACState) -> None:
    """Networks, targets, temperature and Adam's moments as plain arrays."""
    leaves = jax.tree_util.tree_flatten_with_path(sac)[0]
    policies.write_arrays(path, {jax.tree_util.keystr(where): np.asarray(leaf) for where, leaf in leaves})


def read_learner(path: Path, trainer: Trainer) -> SACState:
    """What ``write_learner`` wrote.

    Raises:
        UserError: the file is missing or holds another learner.
    """
    like = jax.eval_shape(trainer.sac.init, jax.random.key(0), 1.0)
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    try:
        with np.load(path, allow_pickle=False) as file:
            given = [jnp.asarray(file[jax.tree_util.keystr(where)]) for where, _ in leaves]
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"cannot read the learner in {path} ({error})") from error
    if [(x.shape, x.dtype) for x in given] != [(x.shape, x.dtype) for _, x in leaves]:
        raise UserError(f"{path} holds the learner of another expert or of other sizes")
    return jax.tree.unflatten(structure, given)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("expert", choices=sorted(TASKS))
    parser.add_argument("--out", type=Path, required=True, help="folder, see above")
    parser.add_argument("--steps", type=int, required=True, help="environment steps since the start")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--learner", type=Path, help="start from this learner, with an empty replay")
    parser.add_argument("--width", type=int, default=256, help="of the two hidden layers of every network")
    parser.add_argument("--batch-size", type=int, default=256, help="rows per update")
    parser.add_argument("--updates-per-step", type=int, default=16, help="critic updates per step of all environments")
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    sizes = Sizes(hidden=(args.width,) * 2, batch_size=args.batch_size, updates_per_step=args.updates_per_step)
    training = Training(Trainer(TASKS[args.expert](), sizes), args.out, args.seed, args.learner)
    told = {**vars(args), "learner": args.learner and args.learner.name}
    names = ("steps", "seed", "learner", "width", "batch_size", "updates_per_step")
    flags = [f"--{name.replace('_', '-')} {told[name]}" for name in names if told[name] is not None]
    training.run(args.steps, " ".join(["python -m qdos_brax.collection.experts.train", args.expert, *flags]))


if __name__ == "__main__":
    main()
