"""Find the motions that take a fallen humanoid into a crouch: ``python -m qdos_brax.collection.experts.train_motions``.

``turn`` is sought first, ``crouch`` with it, each by CMA-ES over the key poses: a candidate is scored by simulating it
from bodies that fell. The same command continues an interrupted search exactly. DIR holds ``NAME-search.npz``, the
state of a search, from which ``--start`` begins another one, ``NAME.csv``, its curve, and ``humanoid_motions.npz``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes import models
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import falls, rising
from qdos_brax.collection.experts.evolution import Evolution, Search
from qdos_brax.collection.experts.motion_goals import GOALS, MotionGoal
from qdos_brax.collection.experts.records import CurveRow, command_line, read_curve
from qdos_brax.collection.experts.rising import Motions
from qdos_brax.collection.experts.weights import shipped
from qdos_brax.errors import UserError, guarded
from qdos_brax.files import write_arrays, write_text

STARTS = 128  # bodies that fell, from which a search draws
_RECORDED = ("generations", "seed", "start", "spread", "population", "starts", "noise")  # flags, with the motions


class MotionSearch:
    """Find one motion, in a folder, continuing where it was.

    Args:
        goal: which motion.
        motions: the motions so far.
        folder: see the module.
        evolution: the strategy.
        starts: bodies per candidate, drawn anew in every generation.
        noise: standard deviation of the noise on the joints of every second one.
        begun: the search to start from when the folder holds none.

    Raises:
        UserError: the folder's search is of another size.
    """

    def __init__(
        self,
        goal: MotionGoal,
        motions: Motions,
        folder: Path,
        evolution: Evolution,
        starts: int,
        noise: float,
        begun: Search,
    ) -> None:
        self.goal, self.evolution, self.starts = goal, evolution, starts
        self.path, self.curve = folder / f"{goal.name}-search.npz", folder / f"{goal.name}.csv"
        self.search = read_search(self.path, evolution.size) if self.path.exists() else begun
        self.rows = read_curve(self.curve) if self.path.exists() else []
        self._fallen = self._rested(motions)
        shaken = noise * (jnp.arange(starts) % 2)[:, None]
        self._score = jax.jit(lambda candidates, qpos, qvel, key: goal.score(candidates, qpos, qvel, shaken, key))

    def run(self, generations: int) -> None:
        """Make generations until there are ``generations`` in all, saving after every fifth."""
        began = time.monotonic() - (self.rows[-1]["seconds"] if self.rows else 0.0)
        while self.search.generation < generations:
            row = self._generation()
            if self.search.generation % 5 == 0 or self.search.generation == generations:
                self.rows.append(row | {"seconds": round(time.monotonic() - began)})
                print(" ".join(f"{key}={value:.4g}" for key, value in self.rows[-1].items()), flush=True)
                write_arrays(self.path, {name: np.asarray(value) for name, value in self.search._asdict().items()})
                write_text(self.curve, _text(self.rows))

    def _generation(self) -> CurveRow:
        index = int(self.search.generation)
        candidates = self.evolution.ask(self.search)
        chosen = np.random.default_rng((self.evolution.seed, index, 1)).choice(len(self._fallen[0]), self.starts)
        qpos, qvel = (values[chosen] for values in self._fallen)
        values, reached = self._score(jnp.asarray(candidates, jnp.float32), qpos, qvel, jax.random.key(index))
        values = np.asarray(values, float).mean(axis=1)
        self.search = self.evolution.tell(self.search, candidates, values)
        row = {"generation": index + 1, "score": values.mean(), "best": values.max()}
        return row | {"reached": float(np.mean(reached)), "spread": float(self.search.scale)}

    def _rested(self, motions: Motions) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (qpos[n, 28], qvel[n, 27]) of bodies that fell and that this motion is for."""
        drop_key, noise_key = jax.random.split(jax.random.key(self.evolution.seed))
        state = falls.dropped(self.goal.engine, drop_key, STARTS)
        seen = falls.arrivals(self.goal.engine, self.goal.stage, motions, state, jnp.zeros((STARTS, 1)), noise_key)
        arrived = np.asarray(seen.arrived)
        return np.asarray(seen.qpos)[arrived], np.asarray(seen.qvel)[arrived]


def read_search(path: Path, size: int) -> Search:
    """Read the search in ``path`` over ``size`` numbers.

    Raises:
        UserError: the file is missing or holds another one.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            search = Search(*(file[name] for name in Search._fields))
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"cannot read the search in {path} ({error})") from error
    if search.mean.shape != (size,):
        raise UserError(f"{path} holds a search over {search.mean.size} numbers, not {size}")
    return search


def _text(rows: list[CurveRow]) -> str:
    lines = [",".join(rows[0]), *(",".join(f"{value:.5g}" for value in row.values()) for row in rows)]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    option = parser.add_argument
    option("motion", metavar="MOTION", choices=sorted(GOALS), help=f"one of {', '.join(GOALS)}")
    option("--out", metavar="DIR", type=Path, required=True, help="folder for the search, the curve and the motions")
    option("--generations", metavar="N", type=int, required=True, help="generations in total, with earlier calls")
    option("--seed", metavar="S", type=int, default=0, help="seed of all random numbers (default 0)")
    option("--start", metavar="FILE", type=Path, help="start from the centre and shape of this MOTION-search.npz")
    option("--spread", metavar="X", type=float, default=0.4, help="first standard deviation (default 0.4)")
    option("--population", metavar="N", type=int, default=16, help="candidates per generation (default 16)")
    option("--starts", metavar="N", type=int, default=10, help="bodies per candidate (default 10)")
    option("--noise", metavar="X", type=float, default=0.0, help="noise on the joints of half of them (default 0)")
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    args.out.mkdir(parents=True, exist_ok=True)
    goal = GOALS[args.motion](MujocoEngine(models.humanoid_model(), threads=2))
    evolution = Evolution(goal.size, args.population, args.seed)
    begun = evolution.begin(goal.guess(), args.spread)
    if args.start:
        begun = read_search(args.start, goal.size)._replace(scale=np.array(args.spread), generation=np.array(0))
    path = args.out / "humanoid_motions.npz"
    motions, header = rising.read_motions(path if path.exists() else shipped("humanoid_motions"))
    search = MotionSearch(goal, motions, args.out, evolution, args.starts, args.noise, begun)
    search.run(args.generations)
    motions = motions._replace(**{args.motion: goal.motion(jnp.asarray(search.search.mean, jnp.float32))})
    command = command_line("train_motions", args.motion, args, _RECORDED)
    rising.write_motions(path, motions, header | {args.motion: command})


if __name__ == "__main__":
    raise SystemExit(guarded(main))
