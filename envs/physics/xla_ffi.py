"""The part of XLA's foreign-function interface that a NumPy function needs, in ctypes: no compiler at install.

Structures follow ``xla/ffi/api/c_api.h`` of version 0.3, which jaxlib ships (``jax.ffi.include_dir()``); a test
compares them with that file. ``host_function.py`` decides whether the interface is used.
"""

from __future__ import annotations

import ctypes
import functools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

VERSION = (0, 3)
"""(major, minor) of the interface that the structures below follow."""

_HEADER = Path("xla/ffi/api/c_api.h")
_METADATA_EXTENSION = 1
_EXECUTE = 3
_ERROR_INTERNAL = 13
# XLA_FFI_DataType, of the types that jax arrays have here.
_DTYPES = {
    1: np.dtype(np.bool_),
    2: np.dtype(np.int8),
    4: np.dtype(np.int32),
    5: np.dtype(np.int64),
    6: np.dtype(np.uint8),
    8: np.dtype(np.uint32),
    9: np.dtype(np.uint64),
    11: np.dtype(np.float32),
    12: np.dtype(np.float64),
}


class XLA_FFI_Extension_Base(ctypes.Structure):
    """Start every extension of a call."""


XLA_FFI_Extension_Base._fields_ = [
    ("struct_size", ctypes.c_size_t),
    ("type", ctypes.c_int),
    ("next", ctypes.POINTER(XLA_FFI_Extension_Base)),
]
_START: list[Any] = [("struct_size", ctypes.c_size_t), ("extension_start", ctypes.POINTER(XLA_FFI_Extension_Base))]


class XLA_FFI_Api_Version(ctypes.Structure):
    """Hold the version of the interface."""

    _fields_ = [*_START, ("major_version", ctypes.c_int), ("minor_version", ctypes.c_int)]


class XLA_FFI_Metadata(ctypes.Structure):
    """Hold what a handler tells of itself when it is registered."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("api_version", XLA_FFI_Api_Version),
        ("traits", ctypes.c_uint32),
        ("state_type_id", ctypes.c_int64),
    ]


class XLA_FFI_Metadata_Extension(ctypes.Structure):
    """Ask a handler for its metadata."""

    _fields_ = [("extension_base", XLA_FFI_Extension_Base), ("metadata", ctypes.POINTER(XLA_FFI_Metadata))]


class XLA_FFI_Buffer(ctypes.Structure):
    """Describe an array in memory."""

    _fields_ = [
        *_START,
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class XLA_FFI_Args(ctypes.Structure):
    """List the arguments of a call."""

    _fields_ = [
        *_START,
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("args", ctypes.POINTER(ctypes.POINTER(XLA_FFI_Buffer))),
    ]


class XLA_FFI_Rets(ctypes.Structure):
    """List the results of a call."""

    _fields_ = [
        *_START,
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("rets", ctypes.POINTER(ctypes.POINTER(XLA_FFI_Buffer))),
    ]


class XLA_FFI_Error_Create_Args(ctypes.Structure):
    """Hold the arguments from which XLA makes an error."""

    _fields_ = [*_START, ("message", ctypes.c_char_p), ("errc", ctypes.c_int)]


_CREATE_ERROR = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(XLA_FFI_Error_Create_Args))


class XLA_FFI_Api(ctypes.Structure):
    """Hold the first entries of XLA's own table of functions."""

    _fields_ = [
        *_START,
        ("api_version", XLA_FFI_Api_Version),
        ("internal_api", ctypes.c_void_p),
        ("XLA_FFI_Error_Create", _CREATE_ERROR),
    ]


class XLA_FFI_CallFrame(ctypes.Structure):
    """Describe one call of a handler, up to its results; attributes and the future are not used."""

    _fields_ = [
        *_START,
        ("api", ctypes.POINTER(XLA_FFI_Api)),
        ("ctx", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", XLA_FFI_Args),
        ("rets", XLA_FFI_Rets),
    ]


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(XLA_FFI_CallFrame))
_kept: list[Any] = []  # XLA holds bare addresses of the handlers


@functools.cache
def why_not() -> str:
    """Return why the interface cannot be used with this jaxlib; empty where it can."""
    header = Path(jax.ffi.include_dir()) / _HEADER
    try:
        text = header.read_text(encoding="utf-8")
    except OSError as error:
        return f"jaxlib's header {_HEADER} cannot be read ({error.strerror})"
    found = tuple(re.findall(rf"#define XLA_FFI_API_{name} (\d+)", text) for name in ("MAJOR", "MINOR"))
    if found != tuple([str(number)] for number in VERSION):
        version = ".".join("".join(numbers) for numbers in found)
        return f"jaxlib has version {version} of XLA's interface, this code knows {VERSION[0]}.{VERSION[1]}"
    return ""


def register(name: str, function: Callable[..., tuple[np.ndarray, ...]]) -> None:
    """Make ``function`` the target of ``jax.ffi.ffi_call(name, ..)`` on CPUs, for the life of the process.

    Args:
        name: of the target; compiled programs refer to it.
        function: maps NumPy arrays, views of XLA's memory that must not be written or kept, to a tuple of arrays of
            the shapes and types that the call announces. Threads may call it at once. What it raises becomes an XLA
            error with its type and text.
    """
    handler = _HANDLER(functools.partial(_handle, function))
    _kept.append(handler)
    new_capsule = ctypes.pythonapi.PyCapsule_New
    new_capsule.restype, new_capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    capsule = new_capsule(ctypes.cast(handler, ctypes.c_void_p).value, None, None)
    jax.ffi.register_ffi_target(name, capsule, platform="cpu", api_version=1)


def _handle(function: Callable[..., tuple[np.ndarray, ...]], pointer: Any) -> int | None:
    """Answer one call of XLA; an exception must not leave this function, for there is nobody to catch it."""
    frame = pointer.contents
    if frame.extension_start and frame.extension_start.contents.type == _METADATA_EXTENSION:
        extension = ctypes.cast(frame.extension_start, ctypes.POINTER(XLA_FFI_Metadata_Extension))
        version = extension.contents.metadata.contents.api_version
        version.major_version, version.minor_version = VERSION
        return None
    try:
        if frame.stage == _EXECUTE:
            arguments = [_view(frame.args.args[k]) for k in range(frame.args.size)]
            for array in arguments:
                array.flags.writeable = False
            results = function(*arguments)
            for k, result in zip(range(frame.rets.size), results, strict=True):
                target = _view(frame.rets.rets[k])
                if target.shape != result.shape or target.dtype != result.dtype:
                    raise TypeError(f"result {k} is {result.dtype}{result.shape}, not {target.dtype}{target.shape}")
                target[...] = result
    except BaseException as error:
        return _error(frame, error)
    return None


def _view(pointer: Any) -> np.ndarray:
    """Return the buffer as an array on XLA's memory."""
    buffer = pointer.contents
    shape, dtype = tuple(buffer.dims[: buffer.rank]), _DTYPES[buffer.dtype]
    count = math.prod(shape) * dtype.itemsize
    if count == 0:
        return np.empty(shape, dtype)  # XLA may give no address
    memory: Any = (ctypes.c_char * count).from_address(buffer.data)
    return np.frombuffer(memory, dtype).reshape(shape)


def _error(frame: Any, error: BaseException) -> int | None:
    """Return the address of XLA's error for ``error``."""
    text = f"{type(error).__name__}: {error}".encode()
    size = ctypes.sizeof(XLA_FFI_Error_Create_Args)
    arguments = XLA_FFI_Error_Create_Args(struct_size=size, message=text, errc=_ERROR_INTERNAL)
    address: int | None = frame.api.contents.XLA_FFI_Error_Create(ctypes.byref(arguments))
    return address
