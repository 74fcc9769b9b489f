"""Where a run comes from, in run.json: its command, its files, the versions of the packages."""

from __future__ import annotations

import json
import platform
import sys
from importlib import metadata
from pathlib import Path

from qdos_brax.data import relocation
from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.runs.fingerprints import sha256
from qdos_brax.runs.folder import RunFolder

_PACKAGES = ("brax", "flax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "orbax-checkpoint")


def record(folder: RunFolder, data: Path, data_sha256: str, skills: str | None) -> None:
    """Write run.json; if it is there already, refuse other files than those that the run began with.

    Args:
        folder: of the run.
        data: the data file.
        data_sha256: its SHA-256.
        skills: the file of skills that the run begins on, or None.

    Raises:
        UserError: a file is another than at the start.
    """
    digest = None if skills is None else sha256(Path(skills))
    if folder.provenance.exists():
        relocation.check_same(folder, data, data_sha256)
        if digest != folder.read_origin().get("skills", {}).get("sha256"):
            raise UserError(f"{skills} is not the file that the run in {folder.path} began with; restore it")
        return
    content = {
        "command": sys.argv,
        "dataset": {"path": str(data.absolute()), "sha256": data_sha256},
        **({} if skills is None else {"skills": {"path": skills, "sha256": digest}}),
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in _PACKAGES},
    }
    write_text(folder.provenance, json.dumps(content, indent=2) + "\n")
