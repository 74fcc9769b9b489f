"""Settings of jax that must be made before it is first used."""

from __future__ import annotations

import contextlib
import os

import jax

from qdos_brax.runs import compile_cache


def prepare_jax() -> None:
    """Apply the settings that must be made before jax is first used."""
    # MuJoCo C is called back from compiled programs; with asynchronous dispatch on a CPU such a callback can wait for
    # ever on arrays that wait for it (jax issue 25861). Long programs lose nothing by it; accelerators ignore it.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    _make_cores_devices()
    compile_cache.enable()


def _make_cores_devices() -> None:
    """Make every core a device, over which members are spread, unless the user has set the number of devices."""
    given = "JAX_NUM_CPU_DEVICES" in os.environ
    if given or "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    with contextlib.suppress(RuntimeError):  # jax is in use already, as in a notebook: its devices stay as they are
        jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
