"""Fetching, against a server that stalls, truncates, lies, forgets ranges and changes its mind."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main
from qdos_brax.data import download, sources
from qdos_brax.data.sources import PublicDataset
from qdos_brax.errors import UserError

NAME = "antmaze-medium-navigate-v0"
PATIENCE = download.Patience(stall=0.5, attempts=3, pause=0.01)
HALF = 60_000

Answer = Callable[["Handler"], None]


class Handler(BaseHTTPRequestHandler):
    """Does what the server's ``answers`` say, one per request and the last for all that follow; notes the requests."""

    server: Server

    def do_GET(self) -> None:
        server = self.server
        server.requests.append((self.path, self.headers.get("Range")))
        answer = server.answers[min(len(server.requests), len(server.answers)) - 1]
        answer(self)

    def log_message(self, *args: object) -> None:
        pass

    def head(self, status: int, length: int | None, **headers: str) -> None:
        self.send_response(status)
        if length is not None:
            self.send_header("Content-Length", str(length))
        for key, value in headers.items():
            self.send_header(key.replace("_", "-"), value)
        self.end_headers()


class Server(ThreadingHTTPServer):
    """Serves ``content`` in the manner of ``answers``."""

    daemon_threads = True

    def __init__(self, content: bytes) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.content = content
        self.answers: list[Answer] = [honest]
        self.requests: list[tuple[str, str | None]] = []
        self.released = threading.Event()

    @property
    def source(self) -> PublicDataset:
        return PublicDataset(NAME, f"{NAME}.npz", (f"http://127.0.0.1:{self.server_address[1]}/original/{NAME}.npz",))


def tag(content: bytes) -> str:
    return f'"{hashlib.md5(content).hexdigest()}"'


def honest(handler: Handler, send: int | None = None) -> None:
    """RFC 9110: a range where If-Range still holds, else everything; ``send`` bytes of it, then the line is cut."""
    content = handler.server.content
    match = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range", ""))
    start = int(match[1]) if match and handler.headers.get("If-Range", tag(content)) == tag(content) else 0
    if match and start >= len(content):
        handler.head(416, 0, Content_Range=f"bytes */{len(content)}")
        return
    rest = content[start:]
    if start:
        span = f"bytes {start}-{len(content) - 1}/{len(content)}"
        handler.head(206, len(rest), ETag=tag(content), Content_Range=span)
    else:
        handler.head(200, len(rest), ETag=tag(content), Accept_Ranges="bytes")
    handler.wfile.write(rest[:send])
    handler.wfile.flush()


def broken(handler: Handler) -> None:
    honest(handler, HALF)


def stalled(handler: Handler) -> None:
    honest(handler, HALF)
    handler.server.released.wait(20)


def without_ranges(handler: Handler) -> None:
    handler.head(200, len(handler.server.content), ETag=tag(handler.server.content))
    handler.wfile.write(handler.server.content)


def without_ranges_broken(handler: Handler) -> None:
    handler.head(200, len(handler.server.content), ETag=tag(handler.server.content))
    handler.wfile.write(handler.server.content[:HALF])


def too_long_a_length(handler: Handler) -> None:
    handler.head(200, len(handler.server.content) + 500, ETag=tag(handler.server.content))
    handler.wfile.write(handler.server.content)


def too_short_a_length(handler: Handler) -> None:
    handler.head(200, HALF, ETag=tag(handler.server.content))
    handler.wfile.write(handler.server.content[:HALF])


def no_length(handler: Handler) -> None:
    handler.head(200, None)
    handler.wfile.write(handler.server.content)


def a_page(handler: Handler) -> None:
    handler.head(200, 21, Content_Type="text/html")
    handler.wfile.write(b"<html>Sorry!</html>\r\n")


def another_range(handler: Handler) -> None:
    if "Range" not in handler.headers:
        broken(handler)
        return
    content = handler.server.content
    handler.head(206, len(content) - 5, ETag=tag(content), Content_Range=f"bytes 5-{len(content) - 1}/{len(content)}")
    handler.wfile.write(content[5:])


def refusing(status: int) -> Answer:
    return lambda handler: handler.head(status, 0)


def npz(path: Path, seed: int = 0) -> bytes:
    np.savez(path, noise=np.random.default_rng(seed).random(20_000))
    return path.read_bytes()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    server = Server(npz(tmp_path / "original.npz"))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.released.set()
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "data"


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {f"{NAME}.lock"}


WHOLE = {f"{NAME}.npz", f"{NAME}.npz.json"}


def test_a_fetched_file_is_recorded_and_not_fetched_again(server: Server, folder: Path) -> None:
    path, digest = download.fetch(server.source, folder, PATIENCE)
    assert path.read_bytes() == server.content and names(folder) == WHOLE
    record = json.loads((folder / f"{NAME}.npz.json").read_text())
    assert record == {
        "size": len(server.content),
        "sha256": hashlib.sha256(server.content).hexdigest(),
        "url": server.source.urls[0],
    }
    assert download.fetch(server.source, folder, PATIENCE) == (path, digest) and len(server.requests) == 1


@pytest.mark.parametrize("first", [broken, stalled])
def test_a_broken_download_goes_on_where_it_was(server: Server, folder: Path, first: Answer) -> None:
    server.answers = [first, honest]
    started = time.monotonic()
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content
    assert [span for _, span in server.requests] == [None, f"bytes={HALF}-"]
    assert names(folder) == WHOLE and time.monotonic() - started < 10


def test_a_later_process_goes_on_too(server: Server, folder: Path) -> None:
    server.answers = [broken, refusing(503)]
    with pytest.raises(UserError, match=r"503 .* \(3 attempts\)"):
        download.fetch(server.source, folder, PATIENCE)
    assert (folder / f"{NAME}.npz.part").stat().st_size == HALF
    server.answers, server.requests = [honest], []
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content
    assert server.requests[0][1] == f"bytes={HALF}-"


def test_a_file_that_changed_meanwhile_is_not_patched_together(server: Server, folder: Path, tmp_path: Path) -> None:
    server.answers = [broken, refusing(503)]
    with pytest.raises(UserError):
        download.fetch(server.source, folder, PATIENCE)
    server.content = npz(tmp_path / "changed.npz", seed=1)
    server.answers = [honest]
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content


def test_a_server_without_ranges_starts_over(server: Server, folder: Path) -> None:
    server.answers = [without_ranges_broken, without_ranges]
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content
    server.answers, server.requests = [without_ranges_broken], []
    (folder / f"{NAME}.npz").unlink()
    with pytest.raises(UserError, match=f"truncated at {HALF:,} of {len(server.content):,} bytes"):
        download.fetch(server.source, folder, PATIENCE)
    assert len(server.requests) == 4 and f"{NAME}.npz" not in names(folder)  # one that brought something, three not


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        (too_short_a_length, "not a data file, or only a part"),
        (too_long_a_length, "truncated at"),
        (another_range, "continues elsewhere than asked"),
        (a_page, "not a data file, or only a part"),
        (refusing(404), "404 Not Found"),
    ],
)
def test_lies_leave_no_file_and_say_why(server: Server, folder: Path, lie: Answer, says: str) -> None:
    server.answers = [lie]
    with pytest.raises(UserError, match=says) as error:
        download.fetch(server.source, folder, PATIENCE)
    assert f"{NAME}.npz" not in names(folder) and "\n" not in str(error.value)
    assert len(server.requests) < 10
    server.answers = [honest]
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content


def test_a_size_need_not_be_told(server: Server, folder: Path) -> None:
    server.answers = [no_length]
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content


def test_the_mirror_helps_out(server: Server, folder: Path) -> None:
    server.answers = [refusing(404), honest]
    original = server.source.urls[0]
    source = PublicDataset(NAME, f"{NAME}.npz", (original, original.replace("original", "mirror")))
    assert download.fetch(source, folder, PATIENCE).path.read_bytes() == server.content
    assert [path.split("/")[1] for path, _ in server.requests] == ["original", "mirror"]


def test_what_was_fetched_is_checked_ever_after(server: Server, folder: Path, tmp_path: Path) -> None:
    path = download.fetch(server.source, folder, PATIENCE).path
    content = bytearray(server.content)
    content[1000] ^= 1
    path.write_bytes(content)
    with pytest.raises(UserError, match="has changed since it was fetched"):
        download.fetch(server.source, folder, PATIENCE)
    path.unlink()
    server.content = npz(tmp_path / "changed.npz", seed=1)
    with pytest.raises(UserError, match="is not the one first fetched"):
        download.fetch(server.source, folder, PATIENCE)
    assert not path.exists()
    (folder / f"{NAME}.npz.json").unlink()
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content


def test_offline_is_one_line(folder: Path) -> None:
    """A port that nothing listens at."""
    source = PublicDataset(NAME, f"{NAME}.npz", ("http://127.0.0.1:9/a.npz", "http://no-such-host.invalid/a.npz"))
    with pytest.raises(UserError, match=r"no connection, Connection refused.*offline") as error:
        download.fetch(source, folder, PATIENCE)
    assert "\n" not in str(error.value) and names(folder) == set()


def test_a_full_disk_is_one_line_and_keeps_what_is_there(
    server: Server, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
        with pytest.raises(UserError, match="free some space"):
            download.fetch(server.source, folder, PATIENCE)

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    server.answers = [broken, honest]
    with monkeypatch.context() as patch:
        patch.setattr(download, "_keep", full)
        with pytest.raises(UserError, match=r"No space left on device\); free some space"):
            download.fetch(server.source, folder, PATIENCE)
    server.requests.clear()
    assert download.fetch(server.source, folder, PATIENCE).path.read_bytes() == server.content
    assert server.requests == []  # it was all there


def test_commands_take_names(
    server: Server, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    ogbench = Path(__file__).parent / "files" / "ogbench-antmaze-medium.npz"
    server.content = ogbench.read_bytes()
    monkeypatch.setenv("QDOS_DATA", str(folder))
    monkeypatch.setattr(sources, "find", lambda name: server.source if name == NAME else None)
    assert main(["data", "fetch", NAME]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(folder / f"{NAME}.npz")
    assert main(["data", "info", NAME]) == 0 and "22" in capsys.readouterr().out
    assert main(["data", "check", NAME, "--env", "antmaze-medium", "--horizon", "5"]) == 0
    assert main(["data", "fetch", "antmaze-medium-navigate-v9"]) == 2
    assert "no public data set" in capsys.readouterr().err
    flags = ["--env", "antmaze-medium", "--preset", "smoke", "--out", str(tmp_path / "run")]
    assert train_main([*flags, "--dataset", "antmaze-medium-navigate-v9"]) == 2
    assert "no such file, nor a public data set" in capsys.readouterr().err
    # The name is resolved and the file read: its episodes are too short for a skill.
    assert train_main([*flags, "--dataset", NAME]) == 2
    assert "no episode has" in capsys.readouterr().err
