"""Check this machine: installed packages, jax's devices, caches, whether callbacks return and frames can be drawn."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata

from qdos_brax import __version__
from qdos_brax.runs import compile_cache

_PACKAGES = (
    "brax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "flax",
    "optax",
    "orbax-checkpoint",
    "gymnasium",
    "h5py",
    "numpy",
)
_MODELS = {"kitchen": "gymnasium-robotics", "cube and scene": "ogbench"}  # tasks by the package that has their models
_WATCHDOG_SECONDS = 120

# A batched scan over calls of NumPy, as the MuJoCo C engine makes them. It runs in a process of its own, because a call
# that hangs cannot be stopped from inside.
_CALLBACK_PROBE = """
import jax, jax.numpy as jnp
jax.config.update("jax_cpu_enable_async_dispatch", False)
from envs.physics.host_function import HostFunction, why_pure_callback
double = HostFunction(lambda x: (x * 2,), b"doctor")
def step(x, _):
    return double((jax.ShapeDtypeStruct(x.shape, x.dtype),), x)[0] / 2, None
run = jax.jit(jax.vmap(lambda x: jax.lax.scan(step, x, None, 50)[0]))
x = jnp.ones((64, 4096))
assert bool((run(x) == x).all())
why = why_pure_callback()
print("pure_callback, since " + why if why else "XLA's foreign-function interface")
"""


def examine() -> bool:
    """Print one line per check; return whether all of them passed."""
    checks: tuple[Callable[[], tuple[bool, str]], ...] = (
        _python,
        _packages,
        _models,
        _devices,
        _engines,
        _compile_cache,
        _data,
        _callbacks,
        _drawing,
    )
    results = []
    for check in checks:
        passed, line = check()
        results.append(passed)
        print(f"{'ok ' if passed else 'BAD'} {line}", flush=True)
    return all(results)


def _python() -> tuple[bool, str]:
    good = sys.version_info >= (3, 11)
    return good, f"python {platform.python_version()}" + ("" if good else ": 3.11 or later is needed")


def _packages() -> tuple[bool, str]:
    missing, found = [], []
    for name in _PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        return False, f"packages: {', '.join(missing)} not installed; run: pip install -c constraints.txt -e ."
    return True, f"packages: qdos-brax {__version__}, {', '.join(found)}"


def _models() -> tuple[bool, str]:
    """List the tasks whose models are in packages of an extra; that one is not installed is no failure."""
    found, absent = [], ""
    for tasks, package in _MODELS.items():
        try:
            found.append(f"{tasks} ({package} {metadata.version(package)})")
        except metadata.PackageNotFoundError:
            remedy = "run: pip install -c constraints.txt -e '.[manipulation]'"
            absent += f"; not {tasks}: {package} is not installed; {remedy}"
    return True, f"models: {', '.join(['mazes', *found])}{absent}"


def _devices() -> tuple[bool, str]:
    import jax  # here, so that a jax that cannot start is one failed check and does not end the others

    try:
        devices = jax.devices()
    except RuntimeError as error:
        return False, f"devices: jax cannot start ({' '.join(str(error).split())})"
    kinds = ", ".join(f"{device.platform}:{device.id} ({device.device_kind})" for device in devices)
    return True, f"devices: {kinds}; {len(os.sched_getaffinity(0))} CPU cores"


def _engines() -> tuple[bool, str]:
    """List the engines; one that cannot run here is no failure, because "auto" does not choose it."""
    from envs.physics import ENGINES, resolve_physics, why_not

    try:
        chosen = resolve_physics("auto")
        obstacles = {engine: why_not(engine) for engine in ENGINES}
    except RuntimeError:
        return False, "engines: none, because jax cannot start"
    run = ", ".join(engine + (" (auto)" if engine == chosen else "") for engine in ENGINES if not obstacles[engine])
    absent = "".join(f"; not {engine}: {obstacle}" for engine, obstacle in obstacles.items() if obstacle)
    return True, f"engines: {run}{absent}"


def _compile_cache() -> tuple[bool, str]:
    folder = compile_cache.enable()
    if folder is None:
        return False, f"compile cache: {compile_cache.cache_folder()} cannot be written; set JAX_COMPILATION_CACHE_DIR"
    entries = sum(1 for path in folder.iterdir() if path.is_file())
    return True, f"compile cache: {folder}, {entries} files"


def _data() -> tuple[bool, str]:
    from qdos_brax.data import cache

    folder = cache.folder()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free / 2**30
    good = os.access(there, os.W_OK)
    return good, f"data: {folder}, {free:.0f} GiB free" + ("" if good else "; it cannot be written, set QDOS_DATA")


def _callbacks() -> tuple[bool, str]:
    command = [sys.executable, "-c", _CALLBACK_PROBE]
    try:
        done = subprocess.run(command, timeout=_WATCHDOG_SECONDS, capture_output=True, text=True, check=False)
    except subprocess.TimeoutExpired:
        return False, f"callbacks: no answer in {_WATCHDOG_SECONDS} s; MuJoCo C cannot be used, choose --physics mjx"
    if done.returncode:
        reason = next(reversed(done.stderr.strip().splitlines()), "no message")
        return False, f"callbacks: failed ({reason}); MuJoCo C cannot be used, choose --physics mjx"
    return True, f"callbacks: compiled programs can call Python (by {done.stdout.strip()})"


def _drawing() -> tuple[bool, str]:
    """Say how frames are drawn; that none can be is no failure, because reports do without them."""
    from envs.render import NoOpenGL, check_drawing

    try:
        return True, f"drawing: by {check_drawing()}"
    except NoOpenGL as error:
        return True, f"drawing: no frames in reports, no films: {error}"
