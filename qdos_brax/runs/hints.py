"""Commands that messages tell the user to type next, quoted for the shell."""

from __future__ import annotations

import shlex
from pathlib import Path

_CHECKOUT = (Path(__file__).parents[2] / "train.py").is_file()  # an installed wheel has no train.py


def module_command(*arguments: str | Path) -> str:
    """Return the command ``python -m qdos_brax`` with these arguments."""
    return f"python -m qdos_brax {shlex.join(map(str, arguments))}"


def train_command(*arguments: str | Path) -> str:
    """Return the command that trains with these arguments: ``train.py`` where there is one, else the module."""
    return f"python {'train.py' if _CHECKOUT else '-m qdos_brax train'} {shlex.join(map(str, arguments))}"


def resume_command(path: str | Path) -> str:
    """Return the command that continues the run in ``path``."""
    return train_command("--resume", path)


def resume_flag(path: str | Path) -> str:
    """Return the flag that continues the run in ``path``."""
    return shlex.join(["--resume", str(path)])
