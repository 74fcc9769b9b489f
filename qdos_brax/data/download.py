"""Public data sets by name: fetched once, resumed when interrupted, checked by size and SHA-256 ever after."""

from __future__ import annotations

import contextlib
import errno
import http.client
import json
import os
import re
import shutil
import time
import urllib.error
import urllib.request
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py

from qdos_brax import __version__
from qdos_brax.data import cache, sources
from qdos_brax.data.sources import PublicDataset
from qdos_brax.errors import UserError
from qdos_brax.files import parse_json, write_text
from qdos_brax.runs.fingerprints import sha256_once
from qdos_brax.runs.progress import Progress

_PIECE = 1 << 20  # bytes per step of the progress bar, and at most per read


@dataclass(frozen=True)
class Patience:
    """Set how long to wait for a server.

    Attributes:
        stall: seconds without a byte after which a connection is given up.
        attempts: connections to one address in a row that bring nothing new before the next address is tried.
        pause: seconds before the second of them; doubled each time.
    """

    stall: float = 30.0
    attempts: int = 3
    pause: float = 1.0


class DataFile(NamedTuple):
    """Name a data file.

    Attributes:
        path: the file, or a Minari folder.
        sha256: its SHA-256 as 64 hex digits if it is a public set, which is hashed when it is fetched or checked; None
            for a file of the user's.
    """

    path: Path
    sha256: str | None


class _TryAgain(Exception):
    """Report a failed connection; another may succeed."""


class _AddressFailed(Exception):
    """Report that an address does not give the file."""


def check(name: str) -> None:
    """Raise UserError unless ``name`` is a file or folder that exists or a public data set."""
    if not Path(name).expanduser().exists() and sources.find(name) is None:
        raise UserError(f"{name}: no such file, nor a public data set such as {sources.examples()}")


def lasting_name(name: str) -> str:
    """Return the name by which a data set is found from any folder: a file's absolute path, a public set's name."""
    path = Path(name).expanduser()
    return str(path.absolute()) if path.exists() else name


def resolve(name: str) -> DataFile:
    """Return the file of a data set: ``name`` itself if that exists, else the public set of that name.

    A public set is fetched unless it is in the cache.

    Raises:
        UserError: there is no such file or set, it cannot be fetched, or it has changed since it was fetched.
    """
    check(name)
    path = Path(name).expanduser()
    source = None if path.exists() else sources.find(name)
    return DataFile(path, None) if source is None else fetch(source, cache.folder())


def fetch(source: PublicDataset, folder: Path, patience: Patience = Patience()) -> DataFile:
    """Return the file of ``source`` in ``folder``: download it if it is missing, check it if it is not.

    A file under this name is always complete. An interrupted download continues where it stopped if the server can do
    that and still has the same file. Size and SHA-256 are kept in ``FILE.json`` from the first fetch on.

    Raises:
        UserError: no address gives the file, it is not what it was at the first fetch, or the disk does not take it.
    """
    path = folder / source.file_name
    with cache.locked(path):
        if path.exists():
            return DataFile(path, _check_record(path))
        print(f"fetching  {source.name} into {folder}", flush=True)
        failures = []
        for url in source.urls:
            try:
                return DataFile(path, _fetch_from(url, path, patience))
            except _AddressFailed as error:
                failures.append(f"{url}: {error}")
        raise UserError(
            f"{source.name} cannot be fetched ({'; '.join(failures)}); "
            "if this machine is offline, fetch it elsewhere and give the file with --dataset"
        )


def _fetch_from(url: str, path: Path, patience: Patience) -> str:
    """Download a file and return its SHA-256."""
    partial = path.with_name(f"{path.name}.part")
    best, fruitless, reason = _size(partial), 0, ""
    while fruitless < patience.attempts:
        if fruitless:
            time.sleep(patience.pause * 2 ** (fruitless - 1))
        try:
            with _disk_errors(path.parent):
                _continue(url, partial, patience.stall)
                return _keep(partial, path, url)
        except _TryAgain as error:
            reason = str(error)
            fruitless = 0 if _size(partial) > best else fruitless + 1
            best = max(best, _size(partial))
    raise _AddressFailed(f"{reason} ({patience.attempts} attempts)")


def _continue(url: str, partial: Path, stall: float) -> None:
    """Complete ``partial`` to the announced size; continue where it is if the server's file is the same."""
    state_path = partial.with_name(f"{partial.name}.json")
    state = _read_json(state_path)
    done = _size(partial) if state.get("url") == url and state.get("validator") else 0
    if done and done == state.get("size"):
        return
    headers = {"User-Agent": f"qdos-brax/{__version__}", "Accept-Encoding": "identity"}
    if done:
        headers |= {"Range": f"bytes={done}-", "If-Range": state["validator"]}
    with _connect(urllib.request.Request(url, headers=headers), partial, stall) as response:
        done, total = _begin(response, done, state)
        etag = response.headers.get("ETag") or ""
        # A weak tag does not promise the same bytes.
        validator = response.headers.get("Last-Modified") if not etag or etag.startswith("W/") else etag
        _check_space(partial.parent, total, done)
        write_text(state_path, json.dumps({"url": url, "validator": validator, "size": total}))
        with partial.open("r+b" if done else "wb") as file:
            file.seek(done)
            _copy(response, file, done, total, partial.name.removesuffix(".part"))


def _connect(request: urllib.request.Request, partial: Path, stall: float) -> Any:
    try:
        return urllib.request.urlopen(request, timeout=stall)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # what is here is not a beginning of what is there
            partial.unlink(missing_ok=True)
            raise _TryAgain("the file there has changed") from None
        answer = f"the server answers {error.code} {error.reason}"
        raise (_TryAgain if error.code >= 500 or error.code == 429 else _AddressFailed)(answer) from None
    except (OSError, http.client.HTTPException) as error:
        raise _TryAgain(f"no connection, {_reason(error)}") from None


def _receive(response: Any) -> bytes:
    """Return the bytes of the body that have arrived since (a stall must not lose them); none at its end."""
    try:
        return bytes(response.read1(_PIECE))
    except (OSError, http.client.HTTPException) as error:
        raise _TryAgain(f"the connection broke, {_reason(error)}") from None


def _begin(response: Any, done: int, state: dict[str, Any]) -> tuple[int, int | None]:
    """Return (bytes to keep, size announced) from the answer; a server without ranges sends everything again."""
    length = response.headers.get("Content-Length")
    if response.status != 206:
        return 0, int(length) if length and length.isdigit() else None
    match = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", ""))
    if match is None or int(match[1]) != done or int(match[2]) != (state.get("size") or int(match[2])):
        raise _AddressFailed("the server continues elsewhere than asked")
    return done, int(match[2])


def _copy(response: Any, file: Any, done: int, total: int | None, name: str) -> None:
    """Append the body; raise _TryAgain when it ends before ``total`` bytes have arrived."""
    pieces = -(-total // _PIECE) if total else 0
    first, shown, began = done, done // _PIECE, time.monotonic()
    with Progress(f"fetch {name}", max(1, pieces), shown, waiting_for="connected") as progress:
        while piece := _receive(response):
            file.write(piece)
            done += len(piece)
            while pieces and shown < (pieces if done == total else done // _PIECE):
                shown += 1
                progress.advance((done - first) / 1e6 / max(1e-3, time.monotonic() - began), "MB")
    file.truncate()
    if total is not None and done < total:
        raise _TryAgain(f"truncated at {done:,} of {total:,} bytes")


def _keep(partial: Path, path: Path, url: str) -> str:
    """Rename a complete download, write its record, return its SHA-256; raise _AddressFailed if it is no data file."""
    state_path = partial.with_name(f"{partial.name}.json")
    try:
        if path.suffix == ".npz":
            zipfile.ZipFile(partial).close()
        else:
            h5py.File(partial, "r").close()
    except (OSError, zipfile.BadZipFile):
        partial.unlink()
        raise _AddressFailed("what the server sent is not a data file, or only a part of one") from None
    found = _describe(partial) | {"url": url}
    earlier = _read_json(_record(path))
    if earlier and (earlier.get("size"), earlier.get("sha256")) != (found["size"], found["sha256"]):
        partial.unlink()
        raise _AddressFailed(
            f"the file there is not the one first fetched; to accept it, remove {_record(path)} (SHA-256 "
            f"{found['sha256'][:12]}, then {str(earlier.get('sha256'))[:12]})"
        )
    with partial.open("rb") as file:
        os.fsync(file.fileno())
    write_text(_record(path), json.dumps(found, indent=2) + "\n")
    os.replace(partial, path)
    state_path.unlink(missing_ok=True)
    return str(found["sha256"])


def _check_record(path: Path) -> str:
    """Return the SHA-256 of ``path``; raise UserError if its record differs. A file put there by hand gets a record."""
    record = _read_json(_record(path))
    found = _describe(path)
    if not record:
        write_text(_record(path), json.dumps(found, indent=2) + "\n")
    elif (record.get("size"), record.get("sha256")) != (found["size"], found["sha256"]):
        raise UserError(
            f"{path} has changed since it was fetched ({found['size']:,} bytes, SHA-256 {found['sha256'][:12]}; "
            f"then {record.get('size')}, {str(record.get('sha256'))[:12]}): remove it and it is fetched again"
        )
    return str(found["sha256"])


def _describe(path: Path) -> dict[str, Any]:
    return {"size": path.stat().st_size, "sha256": sha256_once(path)}


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _record(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _read_json(path: Path) -> dict[str, Any]:
    """Return a small JSON object; {} if the file is missing or damaged."""
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _check_space(folder: Path, total: int | None, done: int) -> None:
    needed = (total or 0) - done
    if needed > shutil.disk_usage(folder).free:
        raise OSError(errno.ENOSPC, f"{needed / 1e6:,.0f} MB are needed")


@contextlib.contextmanager
def _disk_errors(folder: Path) -> Any:
    """Turn what the disk refuses into one clear line; what was fetched stays for the next time."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = (
            "free some space and start again, it continues where it was" if full else "set QDOS_DATA to another folder"
        )
        raise UserError(f"{folder} does not take the file ({error.strerror or error}); {remedy}") from None


def _reason(error: Any) -> str:
    cause = getattr(error, "reason", error)  # of a URLError
    if isinstance(cause, TimeoutError):
        return "no more bytes arrived"
    return " ".join(str(getattr(cause, "strerror", None) or cause or type(cause).__name__).split())
