"""A run or a comparison from flags to report: configuration, task, data, phases. What each part does is elsewhere."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import envs
from qdos_brax import config as configs
from qdos_brax.collection.default_set import default_dataset
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.data import download, formats
from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.methods.build import bind_phases, build_context, build_phases, plan_members
from qdos_brax.population.members import Population
from qdos_brax.report.write import Report, write_report
from qdos_brax.runs import comparison, observers, parts, signals
from qdos_brax.runs.folder import RunFolder, new_path
from qdos_brax.runs.hosts import ALONE, Hosts
from qdos_brax.runs.jax_setup import prepare_jax
from qdos_brax.runs.loop import run_phases

_PACKAGES = ("brax", "flax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "orbax-checkpoint")


def start(
    make_configs: Callable[[], Mapping[str, Config]], preset_given: bool, started: float, hosts: Hosts = ALONE
) -> None:
    """A new run to its end; of several configurations a comparison, one run after another.

    Args:
        make_configs: reads the configurations by name, which differ in method or sizes; called once jax may be asked
            for its devices.
        preset_given: whether the user named the preset; if not, the first lines say why it was taken.
        started: ``time.perf_counter()`` at the process's start.
        hosts: the processes that share the run.

    Raises:
        UserError: a flag, a file or the disk is at fault.
    """
    prepare_jax()
    asked = make_configs()
    first = next(iter(asked.values()))
    if first.dataset:
        download.check(first.dataset)
    observers.check(first.run)
    env = _make_env(first)
    if hosts.count > 1 and len(asked) > 1:
        raise UserError("--distributed shares the members of one run; give one method and one value of each size")
    if len(asked) == 1:
        resolved = _resolved(first, env, Path(first.out or _new_path(first, env, first.method)))
        count = len(configs.members(resolved))
        if count < hosts.count:
            raise UserError(f"--distributed: {hosts.count} processes cannot share {count} members; use fewer")
        if hosts.index:
            folder = parts.await_creation(Path(str(resolved.out)))
            _run(configs.from_yaml(folder.config), folder, started, hosts)
            return
        folder = RunFolder.create(str(resolved.out))
        with folder.held(), signals.stops_at_once(folder.path):
            folder.provenance.unlink(missing_ok=True)  # of an attempt in the same folder that ended before training
            write_text(folder.config, configs.to_yaml(resolved))
            if hosts.count > 1:
                parts.create(folder, hosts.count, configs.to_yaml(resolved))
            _announce(resolved, first, chosen=not preset_given)
            _run(resolved, folder, started, hosts)
        return
    path = Path(first.out or _new_path(first, env, "comparison"))
    runs = {name: _resolved(config, _make_env(config), path / name) for name, config in asked.items()}
    comparison.create(path, {name: configs.to_yaml(config) for name, config in runs.items()})
    _compare(path, started, chosen=not preset_given)


def resume(path: str, started: float, hosts: Hosts = ALONE) -> None:
    """Goes on with the run or the comparison in ``path`` to its end.

    Raises:
        UserError: there is none, another process works on it, or it cannot go on.
    """
    prepare_jax()
    if comparison.is_comparison(path):
        _compare(Path(path), started, chosen=False)
    else:
        _go_on(RunFolder.open(path), started, chosen=False, hosts=hosts)


def check_new(path: str) -> None:
    """Refuses a folder that cannot hold a new run; every process does, before they meet.

    Raises:
        UserError: there is something at ``path``.
    """
    if Path(path).exists() and any(Path(path).iterdir()):
        raise UserError(f"{path} is not empty; go on with --resume {path}, or choose another --out")


def _compare(path: Path, started: float, chosen: bool) -> None:
    """Runs what has not ended yet of a comparison, and reports on the whole."""
    with RunFolder(path).held():
        folders = comparison.runs(path)
        for number, (name, folder) in enumerate(folders.items(), 1):
            print(f"\n--- {name}, {number} of {len(folders)} runs", flush=True)
            try:
                _go_on(folder, started, chosen)
            except UserError as error:
                raise UserError(f"{name}: {error} (then: python train.py --resume {path})") from error
            except SystemExit:  # a signal; the run has been saved and has said how to go on with it alone
                print(f"and with the whole comparison: python train.py --resume {path}", file=sys.stderr, flush=True)
                raise
            jax.clear_caches()  # the next run's programs are others
            started = time.perf_counter()
        report = write_report([path], path)
    print(f"\n{report.text}\n\ncompared {', '.join(folders)}")
    _say_files(report)


def _go_on(folder: RunFolder, started: float, chosen: bool, hosts: Hosts = ALONE) -> None:
    """Runs what has not been done yet of a run."""
    if hosts.index:
        _run(configs.from_yaml(folder.config), folder, started, hosts)
        return
    with folder.held(), signals.stops_at_once(folder.path):
        config = configs.replace(configs.from_yaml(folder.config), out=str(folder.path))
        summary = folder.read_summary()
        if summary is not None:
            print(f"{folder.path} has ended already")
            _conclude(folder, summary)
            return
        observers.check(config.run)
        _announce(config, config, chosen)
        _run(config, folder, started, hosts)


def _resolved(asked: Config, env: Any, path: Path) -> Config:
    """The configuration with task, engine and folder as they are, not as they were called."""
    # Without the term alpha weighs nothing: a scan over it would train the same member again and again.
    alpha = {} if METHODS[asked.method].information else {"skills.alpha": 0.0}
    return configs.replace(asked, env=env.spec.full_name, physics=env.backend, out=str(path), **alpha)


def _new_path(config: Config, env: Any, name: str) -> Path:
    return new_path(config.run.root, f"{env.spec.full_name}-{name}")


def _run(config: Config, folder: RunFolder, started: float, hosts: Hosts = ALONE) -> None:
    """Trains the members, or this process's share of them; the first process concludes."""
    shares = parts.parts_of(folder)
    if not shares:
        _conclude(folder, _train(config, folder, configs.members(config), started))
        return
    for index in range(hosts.index, len(shares), hosts.count):
        part = shares[index]
        with part.held():
            if part.read_summary() is None:
                own = configs.replace(configs.from_yaml(part.config), out=str(part.path))
                _train(own, part, parts.share_of(configs.members(own), index, len(shares)), started)
    if hosts.index == 0:
        for part in shares:
            parts.await_end(part)
        ended = [(part, configs.config_hash(configs.from_yaml(part.config))) for part in shares]
        write_text(folder.provenance, shares[0].provenance.read_text(encoding="utf-8"))
        _conclude(folder, parts.merge(folder, ended, configs.config_hash(config)))


def _train(config: Config, folder: RunFolder, members: list[dict[str, Any]], started: float) -> dict[str, Any]:
    """Trains ``members`` in a run folder to their end; the summary."""
    env = _make_env(config)
    before_data = time.perf_counter()
    data_path = formats.data_file(download.resolve(config.dataset) if config.dataset else _default_data(config, env))
    print(f"data      {data_path}", flush=True)
    dataset = formats.read(data_path, env)
    _same_data(folder, data_path)
    data_seconds = time.perf_counter() - before_data
    context = build_context(config, env, dataset)
    phases = build_phases(context)
    found = plan_members(context, phases, members)
    print(f"members   {found.line}", flush=True)
    if config.members_per_program != found.per_program:
        config = configs.replace(config, members_per_program=found.per_program)
        write_text(folder.config, configs.to_yaml(config))
    hyper = configs.population_hyper(config, members)
    bind_phases(phases, Population(hyper, found.per_program, found.devices, found.parked), context.data)
    return run_phases(
        phases,
        folder,
        members,
        config=configs.config_hash(config),
        header={"env": config.env, "method": config.method, "preset": config.preset, "physics": config.physics},
        checkpoint_seconds=config.run.checkpoint_seconds,
        data_seconds=data_seconds,
        started=started,
        observers=observers.make(config.run, folder, members),
    )


def _make_env(config: Config) -> Any:
    try:
        return envs.make(config.env, physics=config.physics)
    except ValueError as error:  # envs knows nothing of UserError; its lines are made for the user all the same
        raise UserError(str(error)) from error


def _default_data(config: Config, env: Any) -> Path:
    """The task's default set, collected if it is not in the cache yet."""
    data = config.data
    return Path(
        default_dataset(
            env,
            transitions=data.transitions,
            degraded_share=data.degraded_share,
            noise=data.noise,
            seed=data.seed,
            num_envs=data.num_envs,
        )
    )


def _same_data(folder: RunFolder, data_path: Path) -> None:
    """Writes down what the run is made from; on resume, refuses other data than at the start."""
    with data_path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if folder.provenance.exists():
        try:
            earlier = str(json.loads(folder.provenance.read_text(encoding="utf-8"))["dataset"]["sha256"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{folder.provenance} is damaged ({error!r}); put it back, or start a new run") from error
        if earlier != digest:
            raise UserError(f"{data_path} is not what the run began with (SHA-256 {digest[:12]}, then {earlier[:12]})")
        return
    content = {
        "command": sys.argv,
        "dataset": {"path": str(data_path), "sha256": digest},
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in _PACKAGES},
    }
    write_text(folder.provenance, json.dumps(content, indent=2) + "\n")


def _announce(config: Config, asked: Config, chosen: bool) -> None:
    """The first lines: what runs, on what, from where to where."""
    devices = jax.devices()
    why = f" (jax sees {'no accelerator' if config.preset == 'cpu' else 'an accelerator'}; --preset says otherwise)"
    alias = "" if asked.env == config.env else f" (asked for as {asked.env})"
    engine = f"{config.physics}" + (" (auto)" if asked.physics == "auto" else "")
    print(f"task      {config.env}{alias}")
    print(f"method    {config.method}, alpha {_list(config.skills.alpha)}, seed {_list(config.seed)}")
    print(f"preset    {config.preset}{why if chosen else ''}")
    print(f"physics   {engine}")
    print(f"device    {len(devices)} x {devices[0].device_kind}, {len(os.sched_getaffinity(0))} CPU cores")
    print(f"run       {config.out}", flush=True)


def _conclude(folder: RunFolder, summary: Mapping[str, Any]) -> None:
    """The report, and the last lines: how it went and where things are."""
    if not folder.inside.exists():
        from qdos_brax.analysis.inside import look_inside  # here, because scikit-learn takes its time

        try:
            look_inside(folder.path)
        except Exception as error:  # whatever it is: the run is done, and the page does without
            print(f"inside    left out: {' '.join(str(error).split()) or repr(error)}", file=sys.stderr, flush=True)
    report = write_report([folder.path], folder.path)
    minutes = summary["wall_seconds"]["total"] / 60
    print(f"\ndone in {minutes:.1f} minutes")
    for member in summary["members"]:
        success = member["eval_success"]
        result = "not evaluated" if success is None else f"success {success:.2f} (best {member['best_success']:.2f})"
        first = member["first_goal_step"]
        if first is not None:
            result += f", first goal after {first:,} env steps"
        elif not member["best_success"]:  # what is learned offline reaches goals without a step online
            result += ", no goal reached"
        state = "" if member["status"] == "ok" else ", FROZEN: its numbers were no longer finite"
        print(f"  alpha {member['alpha']:g}, seed {member['seed']}: {result}{state}")
    print(f"summary   {folder.summary}")
    _say_files(report)
    print(f"evaluate  python -m qdos_brax evaluate {folder.path}", flush=True)


def _say_files(report: Report) -> None:
    print(f"report    {report.page}")
    print(f"curves    {report.curves}", flush=True)


def _list(values: Any) -> str:
    return ", ".join(f"{value:g}" for value in (values if isinstance(values, tuple) else (values,)))
