"""The top of the page: which setting did best, how sure that is, how fast the goal was found, what it cost."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from qdos_brax.report.parts import Card
from qdos_brax.report.statistics import mean_curve, probability_of_improvement
from qdos_brax.report.study import Member, Setting, Study

_ENOUGH = 5  # seeds, below which the bootstrap's interval is far too narrow
PHASES = ("data", "pretrain", "label", "online", "eval")


def cards(study: Study) -> list[Card]:
    """The answers: three for each task, and one on the time of all runs."""
    found = []
    for task in study.tasks:
        where = f", {task}" if len(study.tasks) > 1 else ""
        found += [Card(card.title + where, *card[1:]) for card in _of_task(study, task)]
    return [*found, _time(study)]


def ranked(study: Study, task: str) -> list[tuple[Setting, list[float]]]:
    """(setting, final successes of its seeds) of everything that was evaluated on a task, the best mean first."""
    scores = [(setting, evaluated(setting.members.get(task, []))) for setting in study.settings]
    return sorted(((s, own) for s, own in scores if own), key=lambda pair: -float(np.mean(pair[1])))


def evaluated(members: Iterable[Member]) -> list[float]:
    return [member.success for member in members if not math.isnan(member.success)]


def _of_task(study: Study, task: str) -> Iterable[Card]:
    order = ranked(study, task)
    if not order:
        yield Card("Best success", "-", "Nothing was evaluated.")
        return
    best, scores = order[0]
    mean, low, high = (float(x[0]) for x in mean_curve(np.asarray(scores)[:, None]))
    seeds = f"{len(scores)} seed" + ("s" if len(scores) > 1 else "")
    equal = [setting for setting, own in order if float(np.mean(own)) == mean]
    interval = "" if math.isnan(low) else f" (95 % interval of the mean: {100 * low:.0f} to {100 * high:.0f} %)"
    if mean == 0:
        yield Card("Best success", "none", "No setting reached the goal in its last evaluation.")
    elif len(equal) > 1:
        names = "; ".join(setting.label for setting in equal)
        yield Card(
            "Best success", f"{100 * mean:.0f} %, {len(equal)} settings", f"Equal at the last evaluation: {names}."
        )
    else:
        yield Card("Best success", best.label, f"{100 * mean:.0f} %{interval} at the last evaluation, {seeds}.")
    yield _sure(order)
    yield _fastest(study, task)


def _sure(order: list[tuple[Setting, list[float]]]) -> Card:
    title = "How sure"
    if len(order) == 1:
        return Card(title, f"{len(order[0][1])} seeds", "One setting only: nothing to compare it with.")
    (best, ours), (second, theirs) = order[:2]
    chance, low, high = probability_of_improvement([ours], [theirs])
    between = "" if math.isnan(low) else f" (95 % interval: {low:.2f} to {high:.2f})"
    if math.isclose(chance, 0.5):  # "beats with a chance of 0.50" would sound like a finding
        between = between.replace("interval", "interval of the chance that a seed of the first is better")
        text = f"No difference was seen between {best.label} and {second.label}{between}."
    else:
        text = f"A seed of {best.label} beats one of {second.label} with a chance of {chance:.2f}{between}."
    if min(len(ours), len(theirs)) < _ENOUGH and not math.isnan(low):
        text += " Intervals of so few seeds are too narrow."
    if math.isnan(low):
        return Card(title, "one seed", f"{text} More seeds would say how much that is worth.")
    if low > 0.5:
        return Card(title, "ahead of the next", text)
    return Card(title, "not told apart", f"{text} More seeds would be needed to tell the two apart.")


def _fastest(study: Study, task: str) -> Card:
    """Of the settings that most of their seeds found the goal with, the one that took the fewest steps."""
    title, found = "Fastest to the goal", []
    for setting in study.settings:
        members = setting.members.get(task, [])
        steps = [member.first_goal for member in members if not math.isnan(member.first_goal)]
        if steps:
            found.append((-len(steps) / len(members), float(np.mean(steps)), setting.label, len(steps), len(members)))
    if not found:
        return Card(title, "none", "No member reached the goal while it learned online.")
    _, mean, label, reached, seeds = min(found)
    return Card(title, label, f"{mean:,.0f} environment steps to the first goal, mean of {reached} of {seeds} seeds.")


def _time(study: Study) -> Card:
    seconds = {phase: sum(float(run.summary["wall_seconds"].get(phase, 0)) for run in study.runs) for phase in PHASES}
    total = sum(float(run.summary["wall_seconds"].get("total", 0)) for run in study.runs)
    longest = max(PHASES, key=seconds.__getitem__)
    members = sum(len(run.members) for run in study.runs)
    share = f", {100 * seconds[longest] / total:.0f} % of it {longest}" if total else ""
    return Card("Wall time", duration(total), f"{members} members: {duration(total / max(members, 1))} each{share}.")


def duration(seconds: float) -> str:
    """In the unit that suits it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
