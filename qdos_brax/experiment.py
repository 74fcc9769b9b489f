"""A run or a comparison from flags to report: configuration, task, data, phases. Each part is implemented elsewhere."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from qdos_brax import config as configs
from qdos_brax.analysis.conclusion import (
    conclude,
    conclude_comparison,
    listed,
    load_beside,
    read_finished,
    with_alpha,
)
from qdos_brax.analysis.finished import trained_run
from qdos_brax.collection.default_set import default_dataset
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.config.task import make_task
from qdos_brax.data import download, formats, origin, relocation
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.requirements import refuse, remarks, unmet_by_task
from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.methods.build import bind_phases, build_context, build_phases, check_skills, plan_members
from qdos_brax.population.members import Population
from qdos_brax.runs import comparison, observers, shares, signals
from qdos_brax.runs.beside import compile_beside
from qdos_brax.runs.checkpoint import Artifacts
from qdos_brax.runs.fingerprints import sha256_once
from qdos_brax.runs.folder import RunFolder, new_path
from qdos_brax.runs.hints import resume_command, resume_flag
from qdos_brax.runs.hosts import ALONE, Hosts
from qdos_brax.runs.jax_setup import prepare_jax
from qdos_brax.runs.loop import run_phases


class _Data(NamedTuple):
    """Hold a task and the data set of a run.

    Attributes:
        env: the task.
        path: the data file.
        sha256: the file's SHA-256.
        dataset: its transitions, labelled for the task.
        seconds: time that it took to get them.
    """

    env: Any
    path: Path
    sha256: str
    dataset: Dataset
    seconds: float


def start(
    make_configs: Callable[[], Mapping[str, Config]], preset_given: bool, started: float, hosts: Hosts = ALONE
) -> None:
    """Run a new run to its end; for several configurations a comparison, one run after another.

    Args:
        make_configs: reads the configurations by name, which differ in method or sizes; called once jax may be asked
            for its devices.
        preset_given: whether the user named the preset; if not, the first lines give the reason for the choice.
        started: ``time.perf_counter()`` at the process's start.
        hosts: the processes that share the run.

    Raises:
        UserError: a flag or a file is wrong, or the disk refuses.
    """
    prepare_jax()
    asked = make_configs()
    first = next(iter(asked.values()))
    if first.dataset:
        download.check(first.dataset)
    observers.check(first.run)
    for config in asked.values():
        configs.check_method(config)
    env = make_task(first.env, first.physics)
    for config in asked.values():
        refuse(config.env, unmet_by_task(env, config))
        check_skills(config, env)
    if hosts.count > 1 and len(asked) > 1:
        raise UserError("--distributed shares the members of one run; give one method and one value of each size")
    if len(asked) == 1:
        _start_run(first, env, started, hosts, chosen=not preset_given)
        return
    path = Path(first.out or _new_path(first, env, "comparison"))
    runs = {
        name: _resolved(config, make_task(config.env, config.physics), path / name) for name, config in asked.items()
    }
    comparison.create(path, {name: configs.to_yaml(config) for name, config in runs.items()})
    _compare(path, started, chosen=not preset_given)


def _start_run(asked: Config, env: Any, started: float, hosts: Hosts, chosen: bool) -> None:
    config = _resolved(asked, env, Path(asked.out or _new_path(asked, env, asked.method)))
    count = len(configs.members(config))
    if count < hosts.count:
        raise UserError(f"--distributed: {hosts.count} processes cannot share {count} members; use fewer")
    if hosts.index:
        folder = shares.await_creation(Path(str(config.out)))
        _run(configs.from_yaml(folder.config), folder, started, hosts)
        return
    folder = RunFolder.create(str(config.out))
    with folder.held(), signals.stops_at_once(folder.path):
        folder.provenance.unlink(missing_ok=True)  # of an attempt in the same folder that ended before training
        write_text(folder.config, configs.to_yaml(config))
        if hosts.count > 1:
            shares.create(folder, hosts.count, configs.to_yaml(config))
        _announce(config, asked, chosen)
        _run(config, folder, started, hosts)


def resume(path: str, started: float, hosts: Hosts = ALONE, dataset: str | None = None) -> None:
    """Continue the run or the comparison in ``path`` to its end.

    Args:
        path: its folder.
        started: ``time.perf_counter()`` at the process's start.
        hosts: the processes that share the run.
        dataset: where its data has moved to.

    Raises:
        UserError: there is none, another process works on it, it began with other data, or it cannot continue.
    """
    prepare_jax()
    if dataset is not None:
        relocation.relocate(path, dataset)
    if comparison.is_comparison(path):
        _compare(Path(path), started, chosen=False)
    else:
        _continue(RunFolder.open(path), started, chosen=False, hosts=hosts)


def check_new(path: str) -> None:
    """Refuse a folder that cannot hold a new run; every process calls this before they meet.

    Raises:
        UserError: there is something at ``path``.
    """
    if Path(path).exists() and any(Path(path).iterdir()):
        raise UserError(f"{path} is not empty; continue with {resume_flag(path)}, or choose another --out")


def _compare(path: Path, started: float, chosen: bool) -> None:
    """Run the unfinished runs of a comparison, and report on all of them."""
    with RunFolder(path).held():
        folders = comparison.runs(path)
        for number, (name, folder) in enumerate(folders.items(), 1):
            print(f"\n--- {name}, {number} of {len(folders)} runs", flush=True)
            try:
                _continue(folder, started, chosen)
            except UserError as error:
                raise UserError(f"{name}: {error} (then: {resume_command(path)})") from error
            except SystemExit:  # a signal; the run was saved and its own --resume printed
                print(f"for the whole comparison: {resume_command(path)}", file=sys.stderr, flush=True)
                raise
            jax.clear_caches()  # the next run's programs are others
            started = time.perf_counter()
        conclude_comparison(path, list(folders))


def _continue(folder: RunFolder, started: float, chosen: bool, hosts: Hosts = ALONE) -> None:
    """Run what has not been done yet of a run."""
    if hosts.index:
        _run(configs.from_yaml(folder.config), folder, started, hosts)
        return
    with folder.held(), signals.stops_at_once(folder.path):
        config = configs.replace(configs.from_yaml(folder.config), out=str(folder.path))
        summary = folder.read_summary()
        if summary is not None:
            print(f"{folder.path} has finished already")
            conclude(folder, summary, lambda: read_finished(folder))
            return
        observers.check(config.run)
        relocation.check_data(folder, config)
        _announce(config, config, chosen)
        _run(config, folder, started, hosts)


def _resolved(asked: Config, env: Any, path: Path) -> Config:
    """Return the configuration with the task's full name, the engine that was chosen, the folder, and lasting paths."""
    # Without the term alpha has no effect: a scan over it would train the same member again and again.
    alpha = {} if METHODS[asked.method].information else {"skills.alpha": 0.0}
    dataset = {"dataset": download.lasting_name(asked.dataset)} if asked.dataset else {}
    return configs.replace(asked, env=env.spec.full_name, physics=env.backend, out=str(path), **dataset, **alpha)


def _new_path(config: Config, env: Any, name: str) -> Path:
    return new_path(config.run.root, f"{env.spec.full_name}-{name}")


def _run(config: Config, folder: RunFolder, started: float, hosts: Hosts = ALONE) -> None:
    """Train the members, or this process's share of them; the first process concludes."""
    own = shares.shares_of(folder)
    if own:
        _run_shares(config, folder, own, started, hosts)
        return
    data = _load_data(config)
    config, summary, artifacts = _train(config, folder, configs.members(config), data, started)
    conclude(folder, summary, lambda: (trained_run(config, data.env, artifacts), data.dataset))


def _run_shares(config: Config, folder: RunFolder, own: list[RunFolder], started: float, hosts: Hosts) -> None:
    data: _Data | None = None
    for index in range(hosts.index, len(own), hosts.count):
        share = own[index]
        with share.held():
            if share.read_summary() is None:
                resolved = configs.replace(configs.from_yaml(share.config), out=str(share.path))
                data = data or _load_data(resolved)
                members = shares.members_of(configs.members(resolved), index, len(own))
                _train(resolved, share, members, data, started)
    if hosts.index:
        return
    for share in own:
        shares.await_end(share)
    ended = [(share, configs.config_hash(configs.from_yaml(share.config))) for share in own]
    write_text(folder.provenance, own[0].provenance.read_text(encoding="utf-8"))
    summary, artifacts = shares.merge(folder, ended, configs.config_hash(config))
    if data is None:  # this process's share had finished before
        conclude(folder, summary, lambda: read_finished(folder))
    else:
        env, dataset = data.env, data.dataset
        conclude(folder, summary, lambda: (trained_run(config, env, artifacts), dataset))


def _load_data(config: Config) -> _Data:
    env = make_task(config.env, config.physics)
    before = time.perf_counter()
    path, digest = _data_file(config, env)
    print(f"data      {path}", flush=True)
    dataset = formats.read(path, env)
    for line in remarks(dataset, config):
        print(f"note      {line}", flush=True)
    return _Data(env, path, digest or sha256_once(path), dataset, time.perf_counter() - before)


def _train(
    config: Config, folder: RunFolder, members: list[dict[str, Any]], data: _Data, started: float
) -> tuple[Config, dict[str, Any], Artifacts]:
    """Train ``members`` in a run folder to their end.

    Returns:
        The configuration with the members of a program as planned, the summary, and what was learned.
    """
    origin.record(folder, data.path, data.sha256, config.skills_file)
    load_beside()
    context = build_context(config, data.env, data.dataset)
    phases = build_phases(context)
    found = plan_members(context, phases, members)
    print(f"members   {found.line}", flush=True)
    if config.members_per_program != found.per_program:
        config = configs.replace(config, members_per_program=found.per_program)
        write_text(folder.config, configs.to_yaml(config))
    hyper = configs.population_hyper(config, members)
    bind_phases(phases, Population(hyper, found.per_program, found.devices, found.parked), context.data)
    if not folder.metrics.exists():  # a run that goes on may need the last phase's programs alone
        compile_beside(phases, len(members))
    summary, artifacts = run_phases(
        phases,
        folder,
        members,
        config=configs.config_hash(config),
        header={"env": config.env, "method": config.method, "preset": config.preset, "physics": config.physics},
        checkpoint_seconds=config.run.checkpoint_seconds,
        data_seconds=data.seconds,
        started=started,
        observers=observers.make(config.run, folder, members),
    )
    return config, summary, artifacts


def _data_file(config: Config, env: Any) -> tuple[Path, str | None]:
    """Return the data file and its SHA-256 if that is known; collect the default set if it is not in the cache."""
    if config.dataset:
        found = download.resolve(config.dataset)
        return formats.data_file(found.path), found.sha256
    return default_dataset(env, **dataclasses.asdict(config.data)), None


def _announce(config: Config, asked: Config, chosen: bool) -> None:
    """Print the first lines: what runs, on which machine, and where."""
    devices = jax.devices()
    why = f" (jax sees {'no accelerator' if config.preset == 'cpu' else 'an accelerator'}; --preset overrides this)"
    alias = "" if asked.env == config.env else f" (asked for as {asked.env})"
    engine = f"{config.physics}" + (" (auto)" if asked.physics == "auto" else "")
    print(f"task      {config.env}{alias}")
    print(f"method    {config.method}, {with_alpha(config.method, config.skills.alpha)}seed {listed(config.seed)}")
    print(f"preset    {config.preset}{why if chosen else ''}")
    print(f"physics   {engine}")
    print(f"device    {len(devices)} x {devices[0].device_kind}, {len(os.sched_getaffinity(0))} CPU cores")
    print(f"run       {config.out}", flush=True)
