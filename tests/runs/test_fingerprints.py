"""Fingerprints of files: a large one is read once."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from qdos_brax.runs import fingerprints


def test_data_is_hashed_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[Path] = []
    plain = fingerprints.sha256
    monkeypatch.setattr(fingerprints, "sha256", lambda path: hashed.append(path) or plain(path))
    file = tmp_path / "data.npz"
    for content, changed in ((b"first", 1), (b"other", 2), (b"longer", 2)):
        file.write_bytes(content)
        os.utime(file, ns=(changed, changed))
        for _ in range(3):
            assert fingerprints.sha256_once(file) == hashlib.sha256(content).hexdigest()
    assert hashed == [file] * 3
    monkeypatch.chdir(tmp_path)
    assert fingerprints.sha256_once(Path("data.npz")) == hashlib.sha256(b"longer").hexdigest() and len(hashed) == 3
