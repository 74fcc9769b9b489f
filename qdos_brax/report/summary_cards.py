"""The cards at the top of the page: which setting did best, how sure that is, how fast it was, what it cost."""

from __future__ import annotations

import math

import numpy as np

from qdos_brax.report.elements import Card
from qdos_brax.report.next_step import advise
from qdos_brax.report.series import curves
from qdos_brax.report.statistics import mean_curve, probability_of_improvement
from qdos_brax.report.study import Setting, Study, final_results, headline

PHASES = ("data", "pretrain", "label", "online", "eval")
_ENOUGH_SEEDS = 5  # with fewer, the bootstrap's interval is far too narrow


def summary_cards(study: Study) -> list[Card]:
    """Return the answers: up to four for each task, and one on the time of all runs."""
    found = []
    for task in study.tasks:
        where = f", {task}" if len(study.tasks) > 1 else ""
        found += [Card(card.title + where, *card[1:]) for card in _task_cards(study, task)]
    return [*found, _wall_time_card(study)]


def rank_settings(study: Study, task: str) -> list[tuple[Setting, list[float]]]:
    """Return (setting, its seeds' final successes) of all that were evaluated on a task, the best mean first.

    Where nobody succeeded and parts were done, scores take the place of successes (``headline``).
    """
    measure = headline(study, task)
    scores = [(setting, final_results(setting.members.get(task, []), measure)) for setting in study.settings]
    return sorted(((s, own) for s, own in scores if own), key=lambda pair: -float(np.mean(pair[1])))


def format_duration(seconds: float) -> str:
    """Return a duration in the unit that suits it: seconds, minutes or hours."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _task_cards(study: Study, task: str) -> list[Card]:
    order = rank_settings(study, task)
    if not order:
        return [Card("Best success", "-", "No member was evaluated.")]
    best = _best_card(order, headline(study, task))
    return [best, _confidence_card(order), _first_goal_card(study, task), *_next_cards(study, task, order)]


def _best_card(order: list[tuple[Setting, list[float]]], measure: str) -> Card:
    title, (best, scores) = f"Best {measure}", order[0]
    mean, low, high = (float(x[0]) for x in mean_curve(np.asarray(scores)[:, None]))
    equal = [setting.label for setting, own in order if float(np.mean(own)) == mean]
    if mean == 0:
        return Card(title, "none", "No setting reached the goal in its last evaluation.")
    if len(equal) > 1:
        text = f"Equal at the last evaluation: {'; '.join(equal)}."
        return Card(title, f"{100 * mean:.0f} %, {len(equal)} settings", text)
    interval = "" if math.isnan(low) else f" (95 % interval of the mean: {100 * low:.0f} to {100 * high:.0f} %)"
    whole = "" if measure == "success" else " of the task's parts done, and the whole by nobody,"
    result = f"{100 * mean:.0f} %{interval}{whole} at the last evaluation, {_seeds(len(scores))}."
    return Card(title, best.label, result)


def _confidence_card(order: list[tuple[Setting, list[float]]]) -> Card:
    title = "Confidence"
    if len(order) == 1:
        return Card(title, _seeds(len(order[0][1])), "There is only one setting, so nothing to compare it with.")
    (best, ours), (second, theirs) = order[:2]
    chance, low, high = probability_of_improvement([ours], [theirs])
    text = _comparison(best.label, second.label, chance, low, high)
    if math.isnan(low):
        return Card(title, "one seed", f"{text} Only more seeds can show what that is worth.")
    if min(len(ours), len(theirs)) < _ENOUGH_SEEDS:
        text += " With so few seeds, intervals are too narrow."
    if low > 0.5:
        return Card(title, "better than the next", text)
    return Card(title, "no clear difference", f"{text} More seeds are needed to tell the two apart.")


def _comparison(best: str, second: str, chance: float, low: float, high: float) -> str:
    of_chance = " of the probability that a seed of the first is better"
    equal = math.isclose(chance, 0.5)  # "is better with probability 0.50" would sound like a finding
    interval = f" (95 % interval{of_chance if equal else ''}: {low:.2f} to {high:.2f})" if not math.isnan(low) else ""
    if equal:
        return f"No difference was found between {best} and {second}{interval}."
    return f"A seed of {best} is better than one of {second} with probability {chance:.2f}{interval}."


def _first_goal_card(study: Study, task: str) -> Card:
    """Return the setting with the fewest steps, of those whose share of seeds that reached the goal is the largest."""
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


def _next_cards(study: Study, task: str, order: list[tuple[Setting, list[float]]]) -> list[Card]:
    """Return what the curve of the best setting suggests; nothing of a method that only learned offline."""
    title = "How it went"
    if {run.summary["preset"] for run in study.runs} == {"smoke"}:
        text = "Its sizes only show that everything works; nothing is learned with them. Train without --preset smoke."
        return [Card(title, "a smoke run", text)]
    for curve in curves(study, task, f"eval/{headline(study, task)}"):
        if curve.setting is order[0][0] and not curve.offline:
            verdict, text = advise(curve.steps, curve.mean, task)
            return [Card(title, verdict, text)]
    return []


def _wall_time_card(study: Study) -> Card:
    seconds = {phase: sum(float(run.summary["wall_seconds"].get(phase, 0)) for run in study.runs) for phase in PHASES}
    total = sum(float(run.summary["wall_seconds"].get("total", 0)) for run in study.runs)
    longest = max(PHASES, key=seconds.__getitem__)
    members = sum(len(run.members) for run in study.runs)
    share = f", {100 * seconds[longest] / total:.0f} % of it {longest}" if total else ""
    each = format_duration(total / max(members, 1))
    shared = "1 member" if members == 1 else f"{members} members: {each} each"
    return Card("Wall time", format_duration(total), f"{shared}{share}.")


def _seeds(count: int) -> str:
    return f"{count} seed" + ("" if count == 1 else "s")
