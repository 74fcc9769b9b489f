"""A finished run as one file to hand on, and back: what plays, and a card that says where it comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax import __version__
from qdos_brax import config as configs
from qdos_brax.config import Config
from qdos_brax.config.methods import METHODS
from qdos_brax.config.schema import get, skill_keys
from qdos_brax.errors import UserError
from qdos_brax.runs import bundle
from qdos_brax.runs.bundle import Bundle
from qdos_brax.runs.checkpoint import final_artifacts
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.hints import resume_command

# Of what the phases of a run leave: what plays, and what it sees. Labels and values serve training alone.
_HANDED_ON = ("skills", "actor", "policy", "normaliser")


def export_run(run: Path, out: Path, member: int | None = None) -> list[dict[str, Any]]:
    """Write what a finished run has learned to one file.

    Args:
        run: the run folder.
        out: the file.
        member: number of the one member to write, as in metrics.csv; None for all.

    Returns:
        The members that were written, with their scores.

    Raises:
        UserError: it is no finished run, it has no such member, or the file cannot be written.
    """
    folder = RunFolder.open(run)
    config, summary = configs.from_yaml(folder.config), folder.read_summary()
    if summary is None:
        raise UserError(f"the run in {run} has not finished; continue it with: {resume_command(run)}")
    if out.is_dir():
        raise UserError(f"--out {out} is a folder; give the file to write")
    artifacts = final_artifacts(folder.checkpoints, configs.config_hash(config))
    members = configs.members(config)
    scores = summary["members"] or members
    if member is not None:
        if member >= len(members):
            raise UserError(f"--member {member}: the run in {run} has members 0 to {len(members) - 1}")
        config, scores = _config_of(config, members[member]), scores[member : member + 1]
        artifacts = jax.tree.map(lambda leaf: leaf[member : member + 1], artifacts)
    chosen = {name: jax.device_get(artifacts[name]) for name in _HANDED_ON if name in artifacts}
    bundle.write(out, Bundle(_card(folder, config, scores), chosen))
    return [dict(entry) for entry in scores]


def read_export(path: Path) -> tuple[Config, Bundle]:
    """Return the configuration of an exported file, and what it holds.

    Raises:
        UserError: it is no such file, damaged or newer, or its configuration is none of this version's.
    """
    found = bundle.read(path)
    content = found.card.get("config")
    if not isinstance(content, dict):
        raise UserError(f"{path} is damaged: its card holds no configuration")
    config = configs.from_plain(content, str(path))
    count = len(configs.members(config))
    lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(found.arrays)}
    if lengths != {(count,)} or "normaliser" not in found.arrays:
        raise UserError(f"{path} is damaged: its arrays are not those of {count} members")
    return config, Bundle(found.card, jax.tree.map(jnp.asarray, found.arrays))


def skill_settings(path: Path) -> dict[str, Any]:
    """Return the settings that the skills in an exported file were learned with, by dotted key.

    Raises:
        UserError: as ``read_export``.
    """
    config, _ = read_export(path)
    return {key: get(config, key) for key in skill_keys(METHODS[config.method].low_level)}


def _config_of(config: Config, member: dict[str, Any]) -> Config:
    """Return the configuration that has this member alone."""
    values = {"seed": (member["seed"],), "scan.combine": "product", "scan.samples": 0}
    return configs.replace(config, **values, **configs.values_by_key(member))


def _card(folder: RunFolder, config: Config, scores: list[dict[str, Any]]) -> dict[str, Any]:
    origin = folder.read_origin() if folder.provenance.is_file() else {}
    content = configs.plain(config)
    for key in ("out", "dataset", "skills_file", "run"):  # folders of the machine where it was trained
        del content[key]
    return {
        "qdos_brax": __version__,
        "task": config.env,
        "method": config.method,
        "data_sha256": origin.get("dataset", {}).get("sha256"),
        "seeds": sorted({entry["seed"] for entry in scores}),
        "members": scores,
        "command": origin.get("command"),
        "python": origin.get("python"),
        "packages": origin.get("packages"),
        "config": content,
    }
