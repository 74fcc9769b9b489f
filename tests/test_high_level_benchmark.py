"""What ``benchmarks/high_level.py`` trains anew."""

from __future__ import annotations

from types import SimpleNamespace

from benchmarks import high_level


def test_all_that_comes_after_the_skills_is_trained() -> None:
    """A warm start stands between labels and the online phase; left out, its setting would change nothing."""
    phases = [SimpleNamespace(name=name) for name in ("values", "skills", "label", "agent", "online")]
    assert [phase.name for phase in high_level.after_skills(phases)] == ["label", "agent", "online"]
