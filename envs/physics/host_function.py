"""NumPy functions that compiled programs call.

On a CPU XLA calls them through its typed foreign-function interface (``xla_ffi.py``): a call costs a third of
``jax.pure_callback``'s, and jax's persistent cache keeps the programs, which it never does with a ``pure_callback``.
Accelerators, and a jaxlib whose interface is another, take ``pure_callback``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import jax
import numpy as np

from envs.physics import xla_ffi

_registered: set[str] = set()


class HostFunction:
    """Call a NumPy function from inside jit; ``jax.vmap`` broadcasts all arguments and calls once.

    Args:
        function: maps arrays with any number of leading batch axes to a tuple of arrays with the same axes. It is pure
            and uses no jax (jax inside a callback can deadlock, jax issue 24255); threads may call it at once.
        identity: says completely what the function computes: a program in the persistent cache names its target after
            it, so that one made for another model can never find this function. In one process the first function of
            an identity serves all.
    """

    def __init__(self, function: Callable[..., tuple[np.ndarray, ...]], identity: bytes) -> None:
        self.target = f"qdos_{hashlib.sha256(identity).hexdigest()[:32]}"
        self._function = function

    def __call__(self, results: Sequence[jax.ShapeDtypeStruct], *args: jax.Array) -> tuple[jax.Array, ...]:
        """Return what the function makes of ``args``, of the shapes and types ``results``."""
        if why_pure_callback():
            return tuple(jax.pure_callback(self._function, tuple(results), *args, vmap_method="broadcast_all"))
        if self.target not in _registered:
            xla_ffi.register(self.target, self._function)
            _registered.add(self.target)
        return tuple(jax.ffi.ffi_call(self.target, tuple(results), vmap_method="broadcast_all")(*args))


def why_pure_callback() -> str:
    """Return why ``jax.pure_callback`` is used on this machine; empty where XLA's interface is."""
    backend = jax.default_backend()
    return f"jax runs on {backend!r}" if backend != "cpu" else xla_ffi.why_not()
