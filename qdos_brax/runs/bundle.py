"""One file to hand on: arrays in the safetensors format, and a card that says what they are, as JSON in its header.

safetensors (https://github.com/huggingface/safetensors) holds names, types, shapes and numbers and nothing that runs;
its reader checks the header's bounds. It has no checksum of its own: the header's SHA-256 covers the card and the
arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from qdos_brax.errors import UserError
from qdos_brax.files import parse_json, replacing

FORMAT = 1
_KIND = "qdos-brax"
_SEPARATOR = "/"


class Bundle(NamedTuple):
    """Hold what a file holds.

    Attributes:
        card: what the arrays are.
        arrays: nested dicts with text keys, arrays at the leaves.
    """

    card: dict[str, Any]
    arrays: dict[str, Any]


def write(path: Path, bundle: Bundle) -> None:
    """Write a bundle as a whole or not at all; the same bundle gives the same bytes.

    Raises:
        UserError: the file cannot be written.
    """
    flat = _flat(bundle.arrays)
    card = json.dumps(bundle.card)
    header = {"kind": _KIND, "format": str(FORMAT), "card": card, "sha256": _digest(card, flat)}
    with replacing(path) as partial:
        partial.write_bytes(_with_sorted_metadata(save(flat, header)))


def read(path: Path) -> Bundle:
    """Return the bundle in a file, which may come from a stranger.

    Raises:
        UserError: it is a folder or no such file, damaged, or of a newer format.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder: `python -m qdos_brax export {path} --out FILE` makes the file of a run")
    try:
        with safe_open(path, framework="numpy") as file:
            header = dict(file.metadata() or {})
            _check_format(path, header)
            flat = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, the file is no dict
    except (OSError, SafetensorError, TypeError, ValueError, KeyError) as error:
        raise UserError(f"{path}: cannot be read as safetensors ({_line(error)}); export or fetch it again") from error
    card = header.get("card", "")
    if _digest(card, flat) != header.get("sha256"):
        raise UserError(f"{path} is damaged: its numbers do not have its checksum; export or fetch it again")
    try:
        return Bundle(dict(parse_json(card)), _nested(flat))
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged: its card or its names cannot be read ({_line(error)})") from error


def _check_format(path: Path, header: Mapping[str, str]) -> None:
    if header.get("kind") != _KIND:
        raise UserError(f"{path} was not written by `python -m qdos_brax export`; give a file that was")
    version = header.get("format", "")
    if not version.isdigit() or int(version) > FORMAT:
        raise UserError(
            f"{path} has format {version!r}, newer than {FORMAT}, which this version reads; update qdos-brax"
        )


def _digest(card: str, flat: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(card.encode())
    for name in sorted(flat):
        array = np.ascontiguousarray(flat[name])
        digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _with_sorted_metadata(file: bytes) -> bytes:
    """Return a file of safetensors, its metadata in the order of their names: the library's order is random.

    The file is the header's length as 8 bytes, the header as JSON, and the numbers, at offsets from the header's end
    (https://github.com/huggingface/safetensors#format).
    """
    begin = 8 + int.from_bytes(file[:8], "little")
    header = json.loads(file[8:begin])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # the numbers stay aligned
    return len(text).to_bytes(8, "little") + text + file[begin:]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return nested dicts as one, keys joined by slashes."""
    found: dict[str, np.ndarray] = {}
    for key, value in tree.items():
        if _SEPARATOR in key:
            raise ValueError(f"the name {key!r} holds a {_SEPARATOR}")
        name = f"{prefix}{key}"
        found |= _flat(value, name + _SEPARATOR) if isinstance(value, Mapping) else {name: _contiguous(value)}
    return found


def _contiguous(value: Any) -> np.ndarray:
    """Return an array as safetensors takes it, which writes the memory as it lies (ascontiguousarray loses rank 0)."""
    array = np.asarray(value)
    return np.ascontiguousarray(array).reshape(array.shape)


def _nested(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, last = name.split(_SEPARATOR)
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = value
    return tree


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
