"""What ``benchmarks/high_level.py`` trains anew."""

from __future__ import annotations

from types import SimpleNamespace

from benchmarks import high_level


def names(*every: str) -> list[str]:
    """Return the names of those phases that are trained anew."""
    return [phase.name for phase in high_level.after_skills([SimpleNamespace(name=name) for name in every])]


def test_all_that_comes_after_the_skills_is_trained() -> None:
    """A warm start stands between labels and the online phase; left out, its setting would change nothing."""
    assert names("values", "skills", "label", "agent", "online") == ["label", "agent", "online"]


def test_a_method_without_skills_and_one_with_a_guide_are_trained_too() -> None:
    assert names("label", "online") == ["label", "online"]
    assert names("guide", "label", "online") == ["label", "online"]
