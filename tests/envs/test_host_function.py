"""NumPy functions in compiled programs: XLA's interface as jaxlib has it, errors, batches, devices, caches."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.physics import host_function, xla_ffi
from envs.physics.host_function import HostFunction

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]
STRUCTS = (
    xla_ffi.XLA_FFI_Extension_Base,
    xla_ffi.XLA_FFI_Api_Version,
    xla_ffi.XLA_FFI_Metadata,
    xla_ffi.XLA_FFI_Metadata_Extension,
    xla_ffi.XLA_FFI_Buffer,
    xla_ffi.XLA_FFI_Args,
    xla_ffi.XLA_FFI_Rets,
    xla_ffi.XLA_FFI_Error_Create_Args,
    xla_ffi.XLA_FFI_Api,
    xla_ffi.XLA_FFI_CallFrame,
)
# How C's types of the header appear in ctypes; pointers and typedef'd structures by what they are.
C_TYPES = {"size_t": ctypes.c_size_t, "int64_t": ctypes.c_int64, "int": ctypes.c_int, "uint32_t": ctypes.c_uint32}


def header() -> str:
    return (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")


def fields_in_header(name: str) -> list[tuple[str, str]]:
    """(type, name) of every field of a structure of the header, in order."""
    body = re.search(rf"struct {name} \{{(.*?)\n\}}", header(), re.S)
    assert body, name
    text = re.sub(r"//[^\n]*", "", body[1])
    text = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\)", r"void* \1", text)
    found = []
    for declaration in filter(None, (part.strip() for part in text.split(";"))):
        kind, field = re.fullmatch(r"(.*?[\s*]+)(\w+)", declaration, re.S).groups()
        found.append((kind.replace("const ", "").replace("struct ", "").strip(), field))
    return found


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.__name__)
def test_structures_are_those_of_the_header(struct: type[ctypes.Structure]) -> None:
    ours = struct._fields_
    theirs = fields_in_header(struct.__name__)[: len(ours)]
    assert [name for name, _ in ours] == [name for _, name in theirs]
    names = {other.__name__: other for other in STRUCTS}
    for (name, kind), (declared, _) in zip(ours, theirs, strict=True):
        if declared.endswith("*"):
            assert ctypes.sizeof(kind) == ctypes.sizeof(ctypes.c_void_p), name
        elif declared in names:
            assert kind is names[declared], name
        elif declared in C_TYPES:
            assert kind is C_TYPES[declared], name
        elif declared == "XLA_FFI_TypeId":  # a structure of one int64
            assert kind is ctypes.c_int64
        elif declared == "XLA_FFI_Handler_Traits":
            assert "typedef uint32_t XLA_FFI_Handler_Traits" in header() and kind is ctypes.c_uint32
        else:  # an enumeration
            assert declared.startswith("XLA_FFI_") and kind is ctypes.c_int, declared


def test_numbers_of_the_header() -> None:
    text = header()
    for name, value in {
        "XLA_FFI_Extension_Metadata": xla_ffi._METADATA_EXTENSION,
        "XLA_FFI_ExecutionStage_EXECUTE": xla_ffi._EXECUTE,
        "XLA_FFI_Error_Code_INTERNAL": xla_ffi._ERROR_INTERNAL,
    }.items():
        assert re.search(rf"{name} = {value}\b", text), name
    words = {"bool": "PRED", "int": "S", "uint": "U", "float": "F"}
    for code, dtype in xla_ffi._DTYPES.items():
        kind, bits = re.fullmatch(r"([a-z]+)(\d*)", dtype.name).groups()
        assert re.search(rf"XLA_FFI_DataType_{words[kind]}{bits} = {code}\b", text), dtype


def test_interface_is_used_here_and_another_version_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert host_function.why_pure_callback() == ""
    other = tmp_path / "xla/ffi/api/c_api.h"
    other.parent.mkdir(parents=True)
    other.write_text(header().replace("#define XLA_FFI_API_MINOR 3", "#define XLA_FFI_API_MINOR 4"))
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    assert "version 0.4" in xla_ffi.why_not.__wrapped__()
    other.unlink()
    assert "cannot be read" in xla_ffi.why_not.__wrapped__()


def scaled(x: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, ...]:
    return 2 * x, np.where(sign, 1, -1).astype(np.int32)


def call(x: jax.Array, sign: jax.Array, identity: bytes = b"scaled", function=scaled) -> tuple[jax.Array, ...]:
    shapes = (jax.ShapeDtypeStruct(x.shape, x.dtype), jax.ShapeDtypeStruct(sign.shape, jnp.int32))
    return HostFunction(function, identity)(shapes, x, sign)


def test_values_in_jit_vmap_and_scan() -> None:
    x, sign = jnp.arange(6.0).reshape(2, 3), jnp.array([True, False])
    doubled, signs = jax.jit(jax.vmap(call))(x, sign)
    np.testing.assert_array_equal(doubled, 2 * x)
    np.testing.assert_array_equal(signs, [1, -1])
    shared, _ = jax.jit(jax.vmap(call, in_axes=(None, 0)))(x, sign)  # what is not batched is broadcast
    np.testing.assert_array_equal(shared, np.broadcast_to(2 * x, (2, 2, 3)))
    power = jax.jit(lambda x: jax.lax.scan(lambda x, _: (call(x, sign[0])[0], None), x, None, 5)[0])(x)
    np.testing.assert_array_equal(power, 32 * x)


def test_both_ways_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    x, sign = jnp.arange(6.0).reshape(2, 3), jnp.array([True, False])
    ours = jax.vmap(call)(x, sign)
    monkeypatch.setattr(host_function, "why_pure_callback", lambda: "the test wants it")
    for one, other in zip(ours, jax.vmap(call)(x, sign), strict=True):
        np.testing.assert_array_equal(one, other)


def test_arrays_of_size_zero() -> None:
    assert jax.jit(call)(jnp.zeros((0, 3)), jnp.zeros(0, bool))[0].shape == (0, 3)
    doubled, _ = jax.jit(jax.vmap(call))(jnp.zeros((4, 0)), jnp.zeros((4,), bool))
    assert doubled.shape == (4, 0)


def fails(x: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, ...]:
    raise ValueError("the model has no such joint: wörist")


def shrinks(x: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, ...]:
    return x[:1], sign.astype(np.int32)


@pytest.mark.parametrize(
    ("function", "text"), [(fails, "ValueError: the model has no such joint: wörist"), (shrinks, "result 0 is float32")]
)
def test_what_the_function_raises_is_an_error_of_the_program(function, text: str) -> None:
    with pytest.raises(jax.errors.JaxRuntimeError, match=text):
        jax.block_until_ready(jax.jit(lambda x: call(x, x > 0, text.encode(), function))(jnp.arange(3.0)))
    np.testing.assert_array_equal(jax.jit(call)(jnp.ones(3), jnp.ones(3, bool))[0], 2 * np.ones(3))  # and life goes on


def test_arguments_cannot_be_written() -> None:
    def writes(x: np.ndarray, sign: np.ndarray) -> tuple[np.ndarray, ...]:
        x[:] = 0
        return x, sign.astype(np.int32)

    with pytest.raises(jax.errors.JaxRuntimeError, match="read-only"):
        jax.block_until_ready(jax.jit(lambda x: call(x, x > 0, b"writes", writes))(jnp.arange(3.0)))


def test_threads_call_at_once() -> None:
    program = jax.jit(lambda x: jax.lax.scan(lambda x, _: (call(x, x[0] > 0)[0] / 2, None), x, None, 200)[0])
    inputs = [jnp.full(64, float(k)) for k in range(8)]
    program(inputs[0])
    with ThreadPoolExecutor(8) as pool:
        for x, out in zip(inputs, pool.map(program, inputs), strict=True):
            np.testing.assert_array_equal(out, x)


MODES = """
import jax, sys
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
from jax.sharding import PartitionSpec
from tests.envs.test_host_function import call
x, sign = jnp.arange(8.0).reshape(4, 2), jnp.arange(4) % 2 == 0
assert x.dtype == jnp.float64
mesh = jax.sharding.Mesh(np.asarray(jax.devices()), ("d",))
own = PartitionSpec("d")
spread = jax.jit(jax.shard_map(jax.vmap(call), mesh=mesh, in_specs=own, out_specs=own, check_vma=False))
np.testing.assert_array_equal(spread(x, sign)[0], 2 * x)
"""


def test_64_bits_and_several_devices() -> None:
    done = subprocess.run([sys.executable, "-c", MODES], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
