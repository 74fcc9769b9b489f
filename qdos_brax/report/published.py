"""The figures of the QDOS paper (its tables 1 and 2), to stand beside those of a report's runs."""

from __future__ import annotations

from collections.abc import Sequence

from qdos_brax.report.tables import Table

# Success in %, mean and standard deviation over 3 seeds, by task and method as the paper names them.
_SUCCESS = {
    "antmaze-large-task1": {"bc": "41", "iql": "64", "supe": "83 ± 21", "qdos 0.2": "86 ± 6", "qdos 0.3": "96 ± 6"},
    "antsoccer-arena-task1": {"bc": "5", "iql": "50", "supe": "27 ± 31", "qdos 0.2": "73 ± 31", "qdos 0.3": "80 ± 10"},
    "humanoidmaze-medium-task1": {
        "bc": "8",
        "iql": "27",
        "supe": "97 ± 6",
        "qdos 0.2": "97 ± 6",
        "qdos 0.3": "100 ± 0",
    },
    "scene-task1": {"bc": "5", "iql": "51", "supe": "100", "qdos 0.2": "100", "qdos 0.3": "100"},
}
# Environment steps to the first goal.
_FIRST_GOAL = {
    "antmaze-large-task1": {"supe": "13,334 ± 5,774", "qdos": "11,668 ± 9,465"},
    "humanoidmaze-medium-task1": {"supe": "23,334 ± 6,292", "qdos": "19,168 ± 8,036"},
    "scene-task1": {"supe": "5,834 ± 1,443", "qdos": "5,001 ± 0"},
}
_NOTE = (
    "from the paper, on OGBench's data, at its sizes and budgets, 3 seeds: not the conditions of the runs above unless "
    "preset and data say so; - where the paper has no figure"
)


def published_tables(tasks: Sequence[str]) -> list[Table]:
    """Return the paper's figures for those of the tasks (full names) that it has, one table each of its two."""
    titles = {"Published: success (%)": _SUCCESS, "Published: environment steps to the first goal": _FIRST_GOAL}
    return [table for title, found in titles.items() for table in _table(title, found, tasks)]


def _table(title: str, found: dict[str, dict[str, str]], tasks: Sequence[str]) -> list[Table]:
    known = [task for task in tasks if task in found]
    methods = dict.fromkeys(method for task in known for method in found[task])
    rows = [[method, *(found[task].get(method, "-") for task in known)] for method in methods]
    return [Table(title, ["method", *known], rows, _NOTE)] if known else []
