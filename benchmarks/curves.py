"""Keep the learning curves of finished runs: ``python benchmarks/curves.py RUN [RUN ..] --out results/curves.csv``.

One row per evaluation of a member: task, method, preset, view of the skills, alpha, seed, environment steps, success,
score (the share of the task's parts that were done, where it has parts), steps of the first goal, minutes of the whole
run, the command, with the name alone of a data file, for what learns offline alone the gradient steps so far, the
view of all that learns (``observation.view``), the steps of a skill, the run's name in a comparison, and a member's
values of what else a scan varies. Rows of other runs that are in the file stay; rows of the same run (command, part of
a comparison, steps of a skill) are replaced.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path

from qdos_brax.errors import guarded
from qdos_brax.files import write_text
from qdos_brax.report.reading import read_study
from qdos_brax.report.settings import varied_keys
from qdos_brax.report.study import Study
from qdos_brax.runs.comparison import is_comparison

COLUMNS = (
    *("env", "method", "preset", "view", "alpha", "seed"),
    *("env_steps", "eval_success", "eval_score", "first_goal_step", "minutes_of_the_run", "command", "update"),
    *("observation_view", "horizon", "part", "scanned"),
)


def rows_of(study: Study) -> list[dict[str, str]]:
    """Return the rows of all runs of a study."""
    found = []
    for run in study.runs:
        origin = json.loads((run.path / "run.json").read_text(encoding="utf-8"))
        words = origin["command"]
        words = [Path(word).name if words[k - 1] == "--dataset" else word for k, word in enumerate(words)]
        kept = [word for k, word in enumerate(words) if word != "--out" and words[k - 1] != "--out"]
        about = {
            "preset": str(run.summary["preset"]),
            "view": run.config.skills.view,
            "observation_view": run.config.observation.view,
            "horizon": str(run.config.skills.horizon),
            "part": run.path.name if is_comparison(run.path.parent) else "",
            "minutes_of_the_run": f"{run.summary['wall_seconds']['total'] / 60:.1f}",
            "command": " ".join(["python", "train.py", *kept[1:]]),
        }
        scanned = [key for key in varied_keys(run.members, run.config.method) if key != "skills.alpha"]
        for member in run.members:
            goal = "" if member.first_goal != member.first_goal else f"{member.first_goal:.0f}"
            own = {"env": member.task, "method": member.method, "seed": str(member.seed), "first_goal_step": goal}
            own["alpha"] = str(member.values.get("skills.alpha", ""))
            own["scanned"] = " ".join(f"{key}={member.values[key]}" for key in scanned)
            for row in member.rows:
                if row.get("eval/success"):
                    measured = {"eval_success": f"{float(row['eval/success']):.3g}"}
                    if row.get("eval/score"):
                        measured["eval_score"] = f"{float(row['eval/score']):.3g}"
                    update = "" if row["env_steps"] else row["update"]
                    found.append(about | own | measured | {"env_steps": row["env_steps"], "update": update})
    return found


def _of(row: Mapping[str, str | None]) -> tuple[str | None, ...]:
    """Return what tells one run's rows from another's: the runs of a comparison have one command."""
    return tuple(row.get(name) or "" for name in ("command", "part", "method", "horizon"))


def main() -> None:
    """Run the script from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="folders of finished runs")
    parser.add_argument("--out", type=Path, required=True, help="CSV file")
    args = parser.parse_args()
    new = rows_of(read_study(args.runs))
    known: list[dict[str, str]] = []
    replaced = {_of(row) for row in new}
    if args.out.exists():
        with args.out.open(encoding="utf-8", newline="") as file:
            known = [row for row in csv.DictReader(file) if _of(row) not in replaced]
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows([*known, *new])
    write_text(args.out, text.getvalue())
    print(f"{len(new)} rows of {len(args.runs)} runs in {args.out}")


if __name__ == "__main__":
    raise SystemExit(guarded(main))
