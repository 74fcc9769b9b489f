"""What to try next, in words, from the learning curve of the best setting."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_LEARNED = 0.9  # success
_NOTICEABLE = 0.05  # success: smaller changes are noise of a few episodes
_FALL = 0.15  # success
_LAST_PART = 0.75  # of the steps: the change since then says whether the curve still rises


class Advice(NamedTuple):
    """Hold how learning went, in a few words, and what to try next."""

    verdict: str
    text: str


def advise(steps: np.ndarray, success: np.ndarray, task: str) -> Advice:
    """Return what a curve suggests.

    Args:
        steps: float[points], environment steps of the evaluations, increasing.
        success: float[points], 0 to 1, the mean over the seeds; the score where nobody succeeded.
        task: the task's full name.
    """
    last, best = float(success[-1]), float(success.max())
    earlier = float(np.interp(_LAST_PART * steps[-1], steps, success))
    longer = f"--steps {2 * round(float(steps[-1])):d}"
    if best == 0:
        return Advice(
            "never reached the goal",
            f"See whether the data visits it (python -m qdos_brax data check FILE --env {task}; FILE is named at the "
            f"end of this page) and how far the skills get (benchmarks/skills.py); then try {longer}.",
        )
    if last >= _LEARNED:
        return Advice("learned", "Compare it with other methods: --method qdos,supe --seed 0,1,2.")
    if best - last > _FALL:
        return Advice("fell back", f"It was at {100 * best:.0f} % before: more seeds tell noise from harm.")
    if last - earlier > _NOTICEABLE:
        return Advice("still rising", f"By {100 * (last - earlier):.0f} points in the last quarter: try {longer}.")
    return Advice(
        "levelled off",
        "No rise in the last quarter: what the skills can reach may be the limit (benchmarks/skills.py measures it); "
        "try another skills.alpha, more updates (high_level.utd), or more data.",
    )
