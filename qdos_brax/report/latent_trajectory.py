"""An episode as its path in latent space, over the skills of the data, with marks where pictures show its scene.

As figure 7 of the paper.
"""

from __future__ import annotations

from qdos_brax.report.elements import PALETTE, Figure, Trace
from qdos_brax.report.maps import MAP_HEIGHT, dots, embedding_layout, path_line
from qdos_brax.report.member_analysis import MemberAnalysis, part_names

SKILLS_COLOUR = "#9aa1aa"  # of the data, behind the path
_TITLE = "the episode in latent space (t-SNE)"
_MARK = {"size": 11, "color": PALETTE[1], "opacity": 1, "line": {"width": 1, "color": "#fff"}}


def latent_trajectory(analysis: MemberAnalysis) -> list[Figure]:
    """Return the chart; nothing for a method whose skills have no place among those of the data."""
    if not {"tsne", "tsne_episode"} <= set(analysis.own):
        return []
    places = analysis.own["tsne_episode"]
    x, y = analysis.own["tsne"].T
    skills = dots(x, y, SKILLS_COLOUR, "segments of the data", analysis)
    skills["marker"] = skills["marker"] | {"size": 5, "opacity": 0.35}
    path = path_line(places, PALETTE[0], "decisions", analysis) | {"showlegend": True}
    path |= {"marker": {"color": PALETTE[0], "size": 5}, "line": {"color": PALETTE[0], "width": 1.5}}
    path |= {"customdata": _words(analysis, len(places)), "hovertemplate": "%{customdata}<extra></extra>"}
    return [
        Figure(_TITLE, [skills | {"hoverinfo": "skip"}, path, *_marks(analysis)], embedding_layout(), height=MAP_HEIGHT)
    ]


def decision_at(analysis: MemberAnalysis, step: int) -> int | None:
    """Return the number of the decision that is played at a step, or ends there; None where each step is one."""
    horizon = int(analysis.member.values["skills.horizon"])
    if horizon == 1 or "latents" not in analysis.own:
        return None
    return min(step // horizon, len(analysis.own["latents"]) - 1)


def picture_decisions(analysis: MemberAnalysis) -> list[int]:
    """Return the number of the decision of each picture; [] without pictures, or where each step is a decision."""
    steps = analysis.own["frame_steps"] if {"frames", "frame_steps"} <= set(analysis.own) else ()
    return [found for step in steps if (found := decision_at(analysis, int(step))) is not None]


def moment(analysis: MemberAnalysis, step: int) -> str:
    """Return a step of the episode in words, with its decision: two pictures of one decision differ in the step."""
    decision = decision_at(analysis, step)
    return f"step {step}" + ("" if decision is None else f", decision {decision}")


def parts_done(analysis: MemberAnalysis, step: int) -> str:
    """Return which parts of the task are done at a step of the episode, in words; "" for a task without parts."""
    names = part_names(analysis)[1:-1]
    if "parts" not in analysis.own or not names:
        return ""
    done = [name for name, is_done in zip(names, analysis.own["parts"][step], strict=True) if is_done]
    return f"done: {', '.join(done) or 'nothing'}"


def _marks(analysis: MemberAnalysis) -> list[Trace]:
    """Return numbered marks at the decisions of the pictures."""
    marked = sorted(set(picture_decisions(analysis)))
    if not marked:
        return []
    x, y = analysis.own["tsne_episode"][marked].T
    text = {"text": [str(decision) for decision in marked], "textposition": "top center", "textfont": {"size": 15}}
    marks = dots(x, y, PALETTE[1], "pictures, by decision", analysis)
    return [marks | text | {"mode": "markers+text", "marker": _MARK, "hoverinfo": "skip"}]


def _words(analysis: MemberAnalysis, decisions: int) -> list[str]:
    """Return what is known of each decision."""
    horizon = int(analysis.member.values["skills.horizon"])
    facts = [[f"decision {i}", f"step {i * horizon}", parts_done(analysis, i * horizon)] for i in range(decisions)]
    return ["<br>".join(filter(None, words)) for words in facts]
