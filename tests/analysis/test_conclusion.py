"""What a run prints of its members, first and last."""

from __future__ import annotations

import pytest
from rich.console import Console

from qdos_brax.analysis.conclusion import listed
from qdos_brax.runs.live import MemberBoard

pytestmark = pytest.mark.quick


def test_seeds_are_whole_and_hyperparameters_short() -> None:
    """A date makes a seed of eight figures, of which six would be two members' alike."""
    assert listed((20261201, 20261202)) == "20261201, 20261202"
    assert listed((0.1, "auto")) == "0.1, auto" and listed(0.30000000000000004) == "0.3"
    console = Console(width=120)
    with console.capture() as shown:
        console.print(MemberBoard([{"seed": 20261201, "alpha": 0.1}, {"seed": 20261202, "alpha": 0.3}]))
    found = shown.get()  # which empties it
    assert "20261201" in found and "20261202" in found and "0.1" in found
