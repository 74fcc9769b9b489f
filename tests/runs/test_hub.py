"""Exported runs on a hub: what a server that speaks its interface gives, and one line for what it does not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from qdos_brax.runs.hub import local_path

COMMITS = {"main": "c" * 40, "v1": "d" * 40}  # of the model repository user/name, by revision
FILES = {"qdos.safetensors": "all members", "first.safetensors": "the first member"}
# In a process of its own: huggingface-hub reads where the hub is when it is imported.
FETCH = """
import json, sys
from qdos_brax.errors import UserError
from qdos_brax.runs.hub import local_path
def fetched(address):
    try:
        return str(local_path(address))
    except UserError as error:
        return f"error: {error}"
print(json.dumps([fetched(address) for address in sys.argv[1:]]))
"""


class Hub(ThreadingHTTPServer):
    """A server that notes what it is asked for."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.asked: list[str] = []


class Answer(BaseHTTPRequestHandler):
    """Gives files as the hub does: HEAD for commit and hash, then GET."""

    server: Hub

    def do_HEAD(self) -> None:
        self.server.asked.append(f"{self.command} {self.path}")
        user, name, _, revision, file = self.path[1:].split("/", 4)
        if (user, name) != ("user", "name"):
            self._refuse("RepoNotFound")
        elif revision not in COMMITS:
            self._refuse("RevisionNotFound")
        elif file not in FILES:
            self._refuse("EntryNotFound", COMMITS[revision])
        else:
            self.send_response(200)
            self.send_header("X-Repo-Commit", COMMITS[revision])
            self.send_header("ETag", f'"{file}-{revision}"')
            self.send_header("Content-Length", str(len(FILES[file])))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(FILES[file].encode())

    do_GET = do_HEAD

    def _refuse(self, code: str, commit: str = "") -> None:
        self.send_response(404)
        self.send_header("X-Error-Code", code)
        self.send_header("X-Repo-Commit", commit)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    server = Hub()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def fetch(hub: Hub, cache: Path, addresses: Sequence[str], **more: str) -> list[str]:
    """Each address's path or error."""
    where = {"HF_ENDPOINT": f"http://127.0.0.1:{hub.server_port}", "HF_HOME": str(cache)}
    command = [sys.executable, "-c", FETCH, *addresses]
    done = subprocess.run(command, env={**os.environ, **where, **more}, capture_output=True, text=True, check=True)
    return list(json.loads(done.stdout))


def test_an_address_is_a_file_here_and_stays_without_a_connection(hub: Hub, tmp_path: Path) -> None:
    hub.asked.clear()
    addresses = ["hub:user/name", "hub:user/name/first.safetensors", "hub:user/name@v1", "hub:user/name"]
    paths = [Path(found) for found in fetch(hub, tmp_path, addresses)]
    assert [path.read_text() for path in paths] == ["all members", "the first member", "all members", "all members"]
    assert [COMMITS["v1" if "@" in a else "main"] in p.parts for a, p in zip(addresses, paths, strict=True)] == [
        True
    ] * 4
    assert [line.split()[0] for line in hub.asked if "/resolve/" in line] == ["HEAD", "GET"] * 3 + ["HEAD"]
    assert [Path(found) for found in fetch(hub, tmp_path, addresses, HF_HUB_OFFLINE="1")] == paths


def test_what_is_not_there_is_one_line(hub: Hub, tmp_path: Path) -> None:
    wanted = {
        "hub:user/other": "error: hub:user/other cannot be fetched (404 Client Error. ",
        "hub:user/name@v9": "error: hub:user/name@v9 cannot be fetched (404 Client Error. ",
        "hub:user/name/none.safetensors": "error: hub:user/name/none.safetensors cannot be fetched (404 Client Error. ",
        "hub:us er/name": "error: hub:us er/name cannot be fetched (Repo id must use alphanumeric chars",
        "hub:user": "error: hub:user is no address on a hub; write hub:USER/NAME",
    }
    for found, beginning in zip(fetch(hub, tmp_path, list(wanted)), wanted.values(), strict=True):
        assert found.startswith(beginning) and "\n" not in found


def test_a_path_stays_a_path() -> None:
    assert local_path("runs/hub") == Path("runs/hub")
