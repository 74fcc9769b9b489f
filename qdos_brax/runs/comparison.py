"""A comparison: a folder of run folders, one per method or choice of sizes, and the order in which they are run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from qdos_brax.errors import UserError
from qdos_brax.files import parse_json, replacing_folder, user_errors, write_text
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_flag

_FILE = "comparison.json"


def is_comparison(path: str | Path) -> bool:
    """Return whether there is a comparison at ``path``."""
    return (Path(path) / _FILE).is_file()


def create(path: Path, configs: Mapping[str, str]) -> None:
    """Create the folder with its run folders, none of them begun; completely or not at all.

    Args:
        path: the comparison's folder, absent or empty.
        configs: config.yaml by name, in the order of the runs.

    Raises:
        UserError: there is something at ``path``, or it cannot be written.
    """
    with user_errors(path):
        if is_comparison(path):
            raise UserError(
                f"{path} holds a comparison already; continue with {resume_flag(path)} or choose another --out"
            )
        if path.exists() and any(path.iterdir()):
            raise UserError(f"{path} is not empty; choose another --out")
    with replacing_folder(path) as partial:
        for name, text in configs.items():
            (partial / name).mkdir()
            write_text(RunFolder(partial / name).config, text)
        write_text(partial / _FILE, json.dumps({"runs": list(configs)}) + "\n")


def runs(path: Path) -> dict[str, RunFolder]:
    """Return the run folders by name, in order.

    Raises:
        UserError: there is no comparison at ``path``, or it is damaged.
    """
    try:
        content = parse_json((path / _FILE).read_text(encoding="utf-8"))
        names = content["methods" if "methods" in content else "runs"]  # "methods" until sizes were compared too
        return {str(name): RunFolder.open(path / name) for name in names}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read {path / _FILE} ({error}); report or resume its run folders one by one") from error
