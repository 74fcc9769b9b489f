"""Run folders written by hand: known successes and first goals, so that every number of a report is known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

STEPS = (1000, 2000, 4000)


def write_run(
    path: Path,
    method: str = "qdos",
    success: Mapping[float, Sequence[float | None]] | Sequence[float | None] = (0.5,),
    *,
    env: str = "antmaze-medium-task1",
    seeds: Sequence[int] | None = None,
    first_goals: Sequence[int | None] | None = None,
    data: str = "d" * 64,
    frozen: Sequence[int] = (),
    scores: Sequence[float] = (),
    more: str = "",
) -> Path:
    """Write the folder of a finished run.

    Args:
        path: the folder.
        method: the method's name.
        success: final success by seed, of alpha 0.2 or by alpha; the curve rises to it linearly.
        env: the task.
        seeds: the seeds; None for 0, 1, ..
        first_goals: by member, seeds first as in a product of seeds and alphas.
        data: SHA-256 of the data file.
        frozen: members whose numbers were no longer finite.
        scores: final scores by member, of a task with parts; the curve rises to them linearly, too.
        more: further lines of config.yaml.
    """
    by_alpha = success if isinstance(success, Mapping) else {0.2: success}
    seeds = range(len(next(iter(by_alpha.values())))) if seeds is None else seeds
    members: list[dict[str, Any]] = []
    tail = ",eval/score" if scores else ""
    lines = [f"member,seed,alpha,phase,env_steps,update,eval/success,eval/return,kl,sps{tail}"]
    for i, seed in enumerate(seeds):
        for alpha, finals in by_alpha.items():
            index, final = len(members), finals[i]
            blank = "," if scores else ""
            lines += [f"{index},{seed},{alpha},skills,,{update},,,{1 / update},9.0{blank}" for update in (10, 20)]
            for step in STEPS:
                value = "" if final is None else final * step / STEPS[-1]
                score = f",{scores[index] * step / STEPS[-1]}" if scores else ""
                lines.append(f"{index},{seed},{alpha},online,{step},{step // 10},{value},{-step},,9.0{score}")
            goal = first_goals[index] if first_goals else None
            members.append(
                {
                    "seed": seed,
                    "alpha": alpha,
                    "env_steps": STEPS[-1],
                    "eval_success": final,
                    "eval_return": -1.0,
                    "eval_episodes": 20,
                    "best_success": final,
                    "first_goal_step": goal,
                    "status": "nan" if index in frozen else "ok",
                }
                | ({"eval_score": scores[index]} if scores else {})
            )
    alphas = list(by_alpha) if len(by_alpha) > 1 else next(iter(by_alpha))
    path.mkdir(parents=True)
    config = f"env: {env}\nmethod: {method}\nphysics: mujoco\nseed: {list(seeds)}\nskills: {{alpha: {alphas}}}\n{more}"
    (path / "config.yaml").write_text(config)
    (path / "metrics.csv").write_text("\n".join(lines) + "\n")
    parts = {"data": 60.0, "pretrain": 120.0, "label": 6.0, "online": 180.0, "eval": 30.0, "total": 400.0}
    header = {"env": env, "method": method, "preset": "paper", "physics": "mujoco", "wall_seconds": parts}
    (path / "summary.json").write_text(json.dumps({**header, "members": members}))
    dataset = {"path": "/data/a <b> & c.hdf5", "sha256": data}
    run = {"command": ["train.py", "--env", env], "dataset": dataset, "python": "3.11.7", "packages": {"jax": "0.10.2"}}
    (path / "run.json").write_text(json.dumps(run))
    return path


def vary(run: Path, **values: list[float]) -> Path:
    """Give the members of a run more hyperparameters that were varied."""
    summary = json.loads((run / "summary.json").read_text())
    for i, member in enumerate(summary["members"]):
        member |= {f"skills.{key}": own[i] for key, own in values.items()}
    (run / "summary.json").write_text(json.dumps(summary))
    return run
