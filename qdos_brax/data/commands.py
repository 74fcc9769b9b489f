"""``python -m qdos_brax data``: make a set, look at a file, check one for a task."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import envs
from qdos_brax.data import cache, formats, recipes
from qdos_brax.data.dataset import episode_bounds
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError

_UNUSABLE = 2  # exit code, as for every error that is the user's to mend


def add_parser(commands: Any) -> None:
    """Adds ``data make | info | check`` to the subparsers ``commands``; sets ``run``."""
    data = commands.add_parser("data", help="make, look at and check data files")
    actions = data.add_subparsers(metavar="ACTION", required=True)

    make = actions.add_parser("make", help="collect a set, by OGBench's recipes or a mixture of good and bad behaviour")
    make.add_argument("task", metavar="TASK", help="the task, as listed by: python -m qdos_brax tasks")
    make.add_argument("--out", metavar="FILE", required=True, help="the file to write (.hdf5, D4RL's flat layout)")
    make.add_argument("--transitions", metavar="N", type=int, default=200_000, help="rows (default 200000)")
    make.add_argument(
        "--recipe",
        choices=recipes.NAMES,
        default="mixed",
        help="OGBench's navigate, stitch or explore, or a mixture of good and bad behaviour (default mixed)",
    )
    make.add_argument(
        "--mix", metavar="M", help="mixed: share of each behaviour, as expert=0.3,noisy=0.3,wander=0.2,fail=0.2"
    )
    make.add_argument(
        "--degraded-share",
        metavar="P",
        type=float,
        help="mixed: share of degraded episodes, in equal parts (default 0.5)",
    )
    make.add_argument(
        "--noise", metavar="X", type=float, help="action noise of the other episodes (default 0.2, explore 1)"
    )
    make.add_argument("--seed", metavar="S", type=int, default=0, help="seed (default 0)")
    make.add_argument("--num-envs", metavar="N", type=int, default=64, help="environments at once (default 64)")
    make.add_argument(
        "--physics", metavar="ENGINE", default="auto", help="auto, mjx or mujoco (default auto: by hardware)"
    )
    make.set_defaults(run=_make)

    info = actions.add_parser("info", help="what is in a data file")
    info.add_argument("file", metavar="FILE", help="an OGBench .npz or a D4RL .hdf5 file")
    info.set_defaults(run=_info)

    check = actions.add_parser("check", help="whether a data file fits a task; exit code 2 if not")
    check.add_argument("file", metavar="FILE", help="an OGBench .npz or a D4RL .hdf5 file")
    check.add_argument("--env", metavar="TASK", required=True, help="the task it shall be used for")
    check.add_argument("--horizon", metavar="H", type=int, default=20, help="steps of a segment (default 20)")
    check.set_defaults(run=_check)


def _make(args: argparse.Namespace) -> int:
    from qdos_brax.train_flow import prepare_jax  # here, for info and check need no learner

    prepare_jax()
    path = Path(args.out).expanduser()
    if path.suffix not in (".hdf5", ".h5"):
        raise UserError(f"--out {args.out}: data is written as .hdf5; give the file that ending")
    env = _env(args.task, args.physics)
    cache.make_file(path, env, args.transitions, _recipe(args), args.seed, args.num_envs)
    print(path)
    return 0


def _recipe(args: argparse.Namespace) -> recipes.Recipe:
    if args.recipe != "mixed":
        if args.mix is not None or args.degraded_share is not None:
            raise UserError(f"--recipe {args.recipe} takes neither --mix nor --degraded-share; mixed does")
        return recipes.named(args.recipe, args.noise)
    noise = recipes.NOISE if args.noise is None else args.noise
    if args.mix is None:
        return recipes.degraded(0.5 if args.degraded_share is None else args.degraded_share, noise)
    if args.degraded_share is not None:
        raise UserError("--mix and --degraded-share both say what is mixed; give one of them")
    return recipes.mixed(recipes.parse_mix(args.mix), noise)


def _info(args: argparse.Namespace) -> int:
    arrays = formats.read_arrays(args.file)
    for name, value in formats.read_attrs(args.file).items():
        print(f"{name:18s} {value}")
    for name, value in arrays.items():
        print(f"{name:18s} {value.dtype} {'x'.join(map(str, value.shape))}")
    bounds = episode_bounds(arrays["ends"])
    if len(bounds) == 0:
        print(f"{'transitions':18s} 0")
        return 0
    lengths = bounds[:, 1] - bounds[:, 0]
    print(f"{'transitions':18s} {len(arrays['ends']):,}")
    print(f"{'episodes':18s} {len(lengths):,} of {lengths.min()} to {lengths.max()} steps")
    print(f"{'largest action':18s} {np.abs(arrays['actions']).max():.4g}")
    if "quality" in arrays:
        shares = ", ".join(f"{name} {np.mean(arrays['quality'] == code):.1%}" for name, code in QUALITY.items())
        print(f"{'behaviour':18s} {shares}")
    return 0


def _check(args: argparse.Namespace) -> int:
    if args.horizon < 1:
        raise UserError(f"--horizon must be at least 1, got {args.horizon}")
    env = _env(args.env, "mujoco")
    arrays = formats.read_arrays(args.file)
    errors = formats.validate(arrays, env)
    notes: list[str] = []
    if len(arrays["ends"]):
        horizon_errors, notes = formats.horizon_lines(arrays["ends"], args.horizon)
        errors += horizon_errors
    for line in errors:
        print(f"error: {line}")
    for line in notes:
        print(f"note: {line}")
    if errors:
        return _UNUSABLE
    dataset = formats.read(args.file, env)
    episodes = dataset.episode_bounds
    reached = sum(1 for first, stop in episodes if (dataset.masks[first:stop] == 0).any())
    print(f"{args.file} fits {env.spec.full_name}: {dataset.size:,} transitions, {len(episodes):,} episodes")
    print(f"{reached:,} episodes reach the goal; {np.mean(dataset.masks == 0):.2%} of the rows are at it")
    return 0


def _env(name: str, physics: str) -> envs.TaskEnv:
    try:
        return envs.make(name, physics=physics)
    except ValueError as error:  # envs knows nothing of UserError; its lines are made for the user all the same
        raise UserError(str(error)) from None
