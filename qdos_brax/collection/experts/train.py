"""Train an expert with SAC on MuJoCo C: ``python -m qdos_brax.collection.experts.train EXPERT --out DIR --steps N``.

The same command continues an interrupted training exactly. DIR holds ``checkpoints/``, the weights ``EXPERT.npz``, the
training curve ``EXPERT.csv``, and ``EXPERT-learner.npz``: networks and optimiser without the replay, small enough to
keep, from which ``--learner`` starts another training.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import time
from dataclasses import asdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.collection.experts.records import CurveRow, command_line, read_curve
from qdos_brax.collection.experts.tasks import TASKS
from qdos_brax.collection.experts.trainer import Sizes, Trainer
from qdos_brax.collection.experts.weights import Actor, write_actor
from qdos_brax.errors import UserError, guarded
from qdos_brax.files import write_arrays, write_text
from qdos_brax.high_level.sac import SACState
from qdos_brax.runs.checkpoint import CheckpointStore, Position, choose

_RECORDED = ("steps", "seed", "learner", "width", "batch_size", "updates_per_step")  # flags, with the weights


class Training:
    """Train in a folder, continuing from its latest checkpoint.

    Args:
        trainer: the program.
        folder: see the module.
        seed: seed of all random numbers.
        learner: a learner's file to start from, or None.
        chunks_per_save: chunks between two checkpoints; at each, the policy is also evaluated.

    Raises:
        UserError: the folder belongs to another training, or the learner does not fit.
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
        self.has_learner = learner is not None
        self.state = trainer.init(train_key, given)
        self.chunks_done, self.seconds = 0, 0.0
        self.rows: list[CurveRow] = []
        choose(self.store, self._restore, print)

    def run(self, steps: int, command: str = "") -> None:
        """Train until ``steps`` environment steps have been made since the start, saving on the way.

        Args:
            steps: environment steps.
            command: the command line, for the header of the weights.
        """
        per_chunk = self.sizes.num_envs * self.sizes.steps_per_chunk
        last = -(-steps // per_chunk)
        while self.chunks_done < last:
            began = time.monotonic()
            is_start = self.chunks_done * per_chunk < self.sizes.random_steps
            self.state, info = self.trainer.chunk(self.state, is_start and not self.has_learner, not is_start)
            info = {name: float(value) for name, value in info.items()}
            self.seconds += time.monotonic() - began
            self.chunks_done += 1
            row: CurveRow = {"steps": self.chunks_done * per_chunk, "seconds": round(self.seconds)}
            print(" ".join(f"{key}={value:.4g}" for key, value in (row | info).items()), flush=True)
            if self.chunks_done % self.chunks_per_save == 0 or self.chunks_done == last:
                self._save(row, command)

    def _save(self, row: CurveRow, command: str) -> None:
        reached = self.trainer.evaluate(self.state.average, self.evaluate_key)
        row = row | {name: float(f"{float(value):.5g}") for name, value in reached.items()}
        self.rows.append(row)
        print("evaluation " + json.dumps(row), flush=True)
        header = {"command": command, "seed": self.seed, **row}
        actor = Actor(self.sizes.hidden, self.trainer.task.action_dim, self.state.average, header)
        write_actor(self.folder / f"{self.name}.npz", actor)
        write_learner(self.folder / f"{self.name}-learner.npz", self.state.sac)
        write_text(self.folder / f"{self.name}.csv", _csv_text(self.rows))
        position = Position(0, self.chunks_done, len(self.rows), tuple(row), {"train": self.seconds})
        self.store.save(position, self.state)

    def _restore(self, name: str) -> None:
        position = self.store.position(name)
        self.state = self.store.restore(name, self.state)
        self.chunks_done, self.seconds = position.chunk, position.wall_seconds["train"]
        self.rows = read_curve(self.folder / f"{self.name}.csv")[: position.rows]


def _csv_text(rows: list[CurveRow]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_learner(path: Path, sac: SACState) -> None:
    """Write networks, targets, temperature and Adam's state as plain arrays; errors as ``files.write_arrays``."""
    leaves = jax.tree_util.tree_flatten_with_path(sac)[0]
    write_arrays(path, {jax.tree_util.keystr(where): np.asarray(leaf) for where, leaf in leaves})


def read_learner(path: Path, trainer: Trainer) -> SACState:
    """Read a file of ``write_learner``.

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
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    option = parser.add_argument
    option("expert", metavar="EXPERT", choices=sorted(TASKS), help=f"one of {', '.join(sorted(TASKS))}")
    option("--out", metavar="DIR", type=Path, required=True, help="folder for checkpoints, weights and curve")
    option("--steps", metavar="N", type=int, required=True, help="environment steps in total, with earlier calls")
    option("--seed", metavar="S", type=int, default=0, help="seed of all random numbers (default 0)")
    option("--learner", metavar="FILE", type=Path, help="start from this EXPERT-learner.npz, with an empty replay")
    option("--width", metavar="N", type=int, default=256, help="width of both hidden layers (default 256)")
    option("--batch-size", metavar="N", type=int, default=256, help="rows per update (default 256)")
    option("--updates-per-step", metavar="N", type=int, default=16, help="critic updates per step (default 16)")
    args = parser.parse_args()
    if args.updates_per_step < 1 or args.updates_per_step % Sizes.actor_every:
        raise UserError(
            f"--updates-per-step must be a multiple of {Sizes.actor_every}, the critic's updates per one of the actor, "
            f"not {args.updates_per_step}"
        )
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    sizes = Sizes(hidden=(args.width,) * 2, batch_size=args.batch_size, updates_per_step=args.updates_per_step)
    training = Training(Trainer(TASKS[args.expert](), sizes), args.out, args.seed, args.learner)
    training.run(args.steps, command_line("train", args.expert, args, _RECORDED))


if __name__ == "__main__":
    raise SystemExit(guarded(main))
