"""What trainings of experts note down: literally as the shipped weights have it."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from qdos_brax.collection.experts.records import command_line, read_curve


def test_the_command_line_is_recorded_without_folders() -> None:
    args = Namespace(out=Path("/here"), steps=100, learner=Path("/there/ant-learner.npz"), batch_size=256, start=None)
    found = command_line("train", "ant_walker", args, ("steps", "learner", "start", "batch_size"))
    expected = "--steps 100 --learner ant-learner.npz --batch-size 256"
    assert found == f"python -m qdos_brax.collection.experts.train ant_walker {expected}"


def test_a_curve_is_read_as_numbers_by_column(tmp_path: Path) -> None:
    (tmp_path / "curve.csv").write_text("steps,speed\n64,0.5\n128,-2e-3\n")
    rows = read_curve(tmp_path / "curve.csv")
    assert rows == [{"steps": 64, "speed": 0.5}, {"steps": 128, "speed": -0.002}]
    # A training that goes on writes the old rows again: counts must not become 64.0.
    assert [type(value) for value in rows[0].values()] == [int, float]
