"""``python -m qdos_brax data``: make, fetch, describe, check and export data files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import envs
from qdos_brax.collection import recipes
from qdos_brax.collection.default_set import make_file
from qdos_brax.collection.makers import CollectorMaker, maker_of
from qdos_brax.config import Config, check_method, load_config
from qdos_brax.config.task import make_task
from qdos_brax.data import checks, download, formats, sources
from qdos_brax.data.dataset import episode_bounds
from qdos_brax.data.quality import QUALITY
from qdos_brax.data.readers.rows import Rows
from qdos_brax.errors import UserError

_UNUSABLE = 2  # exit code, as for every error that the user can fix


def add_parser(commands: Any) -> None:
    """Add ``data make | fetch | info | check | export`` to the subparsers ``commands``; set the handlers as ``run``."""
    data = commands.add_parser("data", help="make, fetch, describe, check and export data files")
    actions = data.add_subparsers(metavar="ACTION", required=True)

    make = actions.add_parser("make", help="collect a set, by OGBench's recipes or a mixture of good and bad behaviour")
    make.add_argument("task", metavar="TASK", help="the task, as listed by: python -m qdos_brax tasks")
    make.add_argument("--out", metavar="FILE", required=True, help="the file to write (.hdf5 in D4RL's flat layout)")
    make.add_argument("--transitions", metavar="N", type=int, default=200_000, help="rows (default 200000)")
    make.add_argument(
        "--recipe",
        choices=recipes.NAMES,
        default="mixed",
        help="in mazes OGBench's navigate, stitch or explore; or a mixture of good and bad behaviour (default mixed)",
    )
    make.add_argument(
        "--mix", metavar="M", help="mixed: share of each behaviour, such as expert=0.3,noisy=0.3,wander=0.2,fail=0.2"
    )
    make.add_argument(
        "--degraded-share",
        metavar="P",
        type=float,
        help="mixed: share of degraded episodes, in equal parts (default 0.5)",
    )
    make.add_argument(
        "--noise",
        metavar="X",
        type=float,
        help="action noise of the other episodes (default 0.2; cubes and scene 0.1; explore: 1, humanoid 0.4)",
    )
    make.add_argument("--seed", metavar="S", type=int, default=0, help="seed (default 0)")
    make.add_argument("--num-envs", metavar="N", type=int, default=64, help="environments at once (default 64)")
    make.add_argument(
        "--physics", metavar="ENGINE", default="auto", help="auto, mjx, mjx-warp or mujoco (default auto: mujoco)"
    )
    make.set_defaults(run=_make)

    fetch = actions.add_parser("fetch", help="fetch a public set by name, or check one that was fetched before")
    fetch.add_argument("names", metavar="NAME", nargs="+", help=f"such as {sources.examples()}")
    fetch.set_defaults(run=_fetch)

    what = "an OGBench .npz, a D4RL .hdf5, a Minari folder, or the name of a public set"
    info = actions.add_parser("info", help="describe a data file")
    info.add_argument("file", metavar="FILE", help=what)
    info.add_argument("--env", metavar="TASK", help="the task for --map (default: the one the file was made for)")
    info.add_argument("--map", metavar="FILE", help="also draw the positions in the data, as .png")
    info.set_defaults(run=_info)

    check = actions.add_parser("check", help="check whether a data file fits a task; exit code 2 if not")
    check.add_argument("file", metavar="FILE", help=what)
    check.add_argument("--env", metavar="TASK", required=True, help="the task to use it for")
    check.add_argument(
        "--method", metavar="NAME", default=Config.method, help=f"the method to train with (default {Config.method})"
    )
    check.add_argument("--preset", metavar="NAME", help="the preset to train with (default: as train.py's)")
    check.add_argument("--horizon", metavar="H", help="steps of a segment (default: the preset's or the method's)")
    check.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="as for train.py; may be repeated"
    )
    check.add_argument("--map", metavar="FILE", help="also draw the positions in the data, as .png")
    check.set_defaults(run=_check)

    export = actions.add_parser("export", help="write a data file as a Minari set, labelled for a task (extra: minari)")
    export.add_argument("file", metavar="FILE", help=what)
    export.add_argument("--env", metavar="TASK", required=True, help="the task, whose rewards it gets")
    export.add_argument("--out", metavar="DIR", required=True, help="the set's folder, named such as antmaze-medium-v0")
    export.set_defaults(run=_export)


def _make(args: argparse.Namespace) -> int:
    from qdos_brax.runs.jax_setup import prepare_jax  # here, since info and check need no learner

    prepare_jax()
    path = Path(args.out).expanduser()
    if path.suffix not in (".hdf5", ".h5"):
        raise UserError(f"--out {args.out}: data is written as .hdf5; give the file that ending")
    env = make_task(args.task, args.physics)
    maker = maker_of(env)
    make_file(
        path, maker.collector(_recipe(args, maker, env.spec.full_name)), args.transitions, args.seed, args.num_envs
    )
    print(path)
    return 0


def _recipe(args: argparse.Namespace, maker: CollectorMaker, task: str) -> recipes.CollectionRecipe:
    if args.recipe != "mixed":
        if args.mix is not None or args.degraded_share is not None:
            raise UserError(
                f"--recipe {args.recipe} takes neither --mix nor --degraded-share; use them with --recipe mixed"
            )
        return maker.named(args.recipe, args.noise)
    noise = load_config(task).data.noise if args.noise is None else args.noise
    if args.mix is None:
        return recipes.degraded(0.5 if args.degraded_share is None else args.degraded_share, maker, noise)
    if args.degraded_share is not None:
        raise UserError("--mix and --degraded-share both set the mixture; give one of them")
    return recipes.mixed(recipes.parse_mix(args.mix), maker, noise)


def _fetch(args: argparse.Namespace) -> int:
    for name in args.names:
        if sources.find(name) is None:
            raise UserError(f"there is no public data set {name!r}; give a name such as {sources.examples()}")
    for name in args.names:
        print(download.resolve(name).path)
    return 0


def _info(args: argparse.Namespace) -> int:
    path = download.resolve(args.file).path
    rows, attributes = formats.load(path), formats.read_attrs(path)
    for name, value in attributes.items():
        print(f"{name:18s} {value}")
    unknown = rows.unknown_next
    for name, array in rows.arrays().items():
        if array is unknown:
            continue  # no array of the file's
        print(f"{name:18s} {array.dtype} {'x'.join(map(str, array.shape))}")
    print(f"{'transitions':18s} {rows.size:,}")
    if rows.size:
        _describe(rows)
    for line in filter(None, (*rows.notes, rows.mismatch)):
        print(f"note: {line}")
    if unknown is not None and unknown.any():
        print(
            f"note: no next_observations: {unknown.sum()} terminal rows that end an episode count where the task ends"
        )
    if args.map:
        task = args.env or attributes.get("env")
        if not task:
            raise UserError(f"{path} does not name the task it was made for; give it with --env")
        _draw_map(args.map, rows, make_task(str(task), "mujoco"), path.name)
    return 0


def _describe(rows: Rows) -> None:
    """Print episodes, returns, actions and behaviour of a set that is not empty."""
    bounds = episode_bounds(rows.ends)
    lengths = bounds[:, 1] - bounds[:, 0]
    print(f"{'episodes':18s} {len(lengths):,} of {lengths.min()} to {lengths.max()} steps")
    if rows.rewards is not None:
        returns = np.add.reduceat(rows.rewards, bounds[:, 0])
        spread = f"{returns.min():.4g} to {returns.max():.4g}, mean {returns.mean():.4g}"
        print(f"{'returns':18s} {spread} (the file's own rewards, undiscounted)")
    print(f"{'largest action':18s} {np.abs(rows.actions).max():.4g}")
    if rows.quality is not None:
        shares = ", ".join(f"{name} {np.mean(rows.quality == code):.1%}" for name, code in QUALITY.items())
        print(f"{'behaviour':18s} {shares}")


def _check(args: argparse.Namespace) -> int:
    flags = {"method": args.method, "skills.horizon": args.horizon}
    given = {key: value for key, value in flags.items() if value is not None}
    config = load_config(args.env, args.preset, given, args.set)
    check_method(config)
    env = make_task(args.env, "mujoco")
    path = download.resolve(args.file).path
    rows = formats.load(path, env.jump)
    found = checks.inspect(rows, env, config, formats.read_attrs(path), str(path))
    for line in found.errors:
        print(f"error: {line}")
    for line in found.notes:
        print(f"note: {line}")
    if args.map:
        _draw_map(args.map, rows, env, path.name)
    dataset = found.dataset
    if found.errors or dataset is None:  # never without errors
        return _UNUSABLE
    episodes = dataset.episode_bounds
    reached = sum(1 for first, stop in episodes if (dataset.masks[first:stop] == 0).any())
    print(f"{args.file} fits {env.spec.full_name}: {dataset.size:,} transitions, {len(episodes):,} episodes")
    print(f"{reached:,} episodes reach the goal; {np.mean(dataset.masks == 0):.2%} of the rows are at it")
    if (parts := env.parts(dataset)) is not None:
        counts = {name: sum(1 for first, stop in episodes if done[first:stop].any()) for name, done in parts.items()}
        print(f"episodes with each part: {', '.join(f'{name} {count:,}' for name, count in counts.items())}")
    return 0


def _export(args: argparse.Namespace) -> int:
    from qdos_brax.data.minari_export import export_minari  # here, since importing gymnasium takes a while

    env = make_task(args.env, "mujoco")
    dataset = formats.read(download.resolve(args.file).path, env)
    export_minari(dataset, Path(args.out).expanduser(), env.spec.full_name)
    print(args.out)
    return 0


def _draw_map(out: str, rows: Rows, env: envs.Task, title: str) -> None:
    from qdos_brax.report.coverage import draw_coverage  # here, since importing matplotlib takes a while

    if rows.qpos is None or rows.qpos.shape[1:] != (env.engine.nq,):
        raise UserError(f"a map needs the simulator states (qpos) of {env.spec.name}, which this file does not hold")
    draw_coverage(rows.qpos, env, Path(out), f"{title}, {env.spec.full_name}")
    print(out)
