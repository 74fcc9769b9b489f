"""Data that has moved: a run that was begun with it reads it from its new place."""

from __future__ import annotations

import json
from pathlib import Path

from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.data import download, formats
from qdos_brax.errors import UserError
from qdos_brax.files import write_text
from qdos_brax.runs import comparison, shares
from qdos_brax.runs.fingerprints import sha256_once
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_command


def relocate(path: str, dataset: str) -> None:
    """Make the run or the comparison in ``path`` read its data from ``dataset`` from now on.

    Raises:
        UserError: there is no such run or data set, another process works on the run, or it began with other data.
    """
    found = download.resolve(dataset)
    file = formats.data_file(found.path)
    digest = found.sha256 or sha256_once(file)
    folders = list(comparison.runs(Path(path)).values()) if comparison.is_comparison(path) else [RunFolder.open(path)]
    folders += [share for folder in folders for share in shares.shares_of(folder)]
    for folder in folders:
        if folder.provenance.exists():  # else it has not begun
            check_same(folder, file, digest)
    for folder in folders:
        with folder.held():
            config = configs.from_yaml(folder.config)
            write_text(folder.config, configs.to_yaml(configs.replace(config, dataset=download.lasting_name(dataset))))
            if folder.provenance.exists():
                origin = folder.read_origin()
                origin["dataset"]["path"] = str(file.absolute())
                write_text(folder.provenance, json.dumps(origin, indent=2) + "\n")


def check_data(folder: RunFolder, config: Config) -> None:
    """Raise UserError if the data of a run that shall continue is gone, with the command that names its new place."""
    try:
        if config.dataset:
            download.check(config.dataset)
    except UserError as error:
        raise UserError(
            f"{config.dataset}, the data of the run, is gone; if it has moved: {resume_command(folder.path)} "
            "--dataset FILE"
        ) from error


def check_same(folder: RunFolder, file: Path, digest: str) -> None:
    """Raise UserError unless ``file``, whose SHA-256 is ``digest``, is what the run, which has begun, began with."""
    earlier = folder.read_origin()["dataset"]["sha256"]
    if earlier != digest:
        raise UserError(
            f"{file} is not the file that the run in {folder.path} began with "
            f"(SHA-256 {digest[:12]}, then {earlier[:12]}); restore it or name it with --dataset, or start a new run"
        )
