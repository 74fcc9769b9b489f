"""Whatever is wrong with what a user gives: one line on stderr, exit code 2, and not a byte of any file changed."""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main
from qdos_brax.config import load_config, to_yaml
from qdos_brax.data import cache
from qdos_brax.runs import comparison
from tests.runs import toy

ROOT = Path(__file__).parents[2]
SOUND = ROOT / "tests" / "data" / "files" / "ogbench-antmaze-medium.npz"
START = "--env antmaze-medium --preset smoke"

TRAIN = [
    "",
    "antmaze",
    "--env",
    "--env antmaze-huge --preset smoke",
    "--env nosuch --preset smoke",
    "--env kitchen-huge --preset smoke --out {new}",
    "--env cube-tripple",
    "--env antmaze-medium-task9 --preset smoke --out {new}",
    "--env antmaze-medium --preset nosuch",
    f"{START} --alpha x",
    f"{START} --alpha -1",
    f"{START} --alpha nan",
    f"{START} --alpha 0.1,0.1",
    f"{START} --seed 1.5",
    f"{START} --seed -1",
    f"{START} --steps 0",
    f"{START} --steps many",
    f"{START} --pretrain-steps -5",
    f"{START} --physics bullet",
    f"{START} --method nosuch",
    f"{START} --method qdos,qdos",
    f"{START} --alpha 0.1,0.2 --sample -1",
    f"{START} --alpha 0.1,0.2 --sample 2 --set scan.draw_seed=-1",
    f"{START} --set skills.alhpa=1",
    f"{START} --set skills",
    f"{START} --set skills.horizon=0",
    f"{START} --nosuch",
    f"{START} --wandb=yes",
    f"{START} --dataset /nowhere.npz --out {{new}}",
    f"{START} --out {{run}}",
    f"{START} --out {{thesis}}",
    f"{START} --out {{file}}",
    f"{START} --out {{file}}/run",
    f"{START} --out /proc/run",
    f"{START} --method qdos,supe --out {{comparison}}",
    "--resume /nowhere",
    "--resume {thesis}",
    "--resume {file}",
    "--resume {run} --seed 3",
    "--resume {run} --wandb",
    "--resume {no_yaml}",
    "--resume {foreign_yaml}",
    "--resume {half_summary}",
    "--resume {damaged_comparison}",
]
OTHERS = [
    "",
    "nosuch",
    "evaluate",
    "evaluate /nowhere",
    "evaluate {thesis}",
    "evaluate {unfinished}",
    "evaluate {run} --episodes 0",
    "evaluate {run} --episodes x",
    "evaluate {run} {run} --video {new}.mp4",
    "evaluate {half_summary}",
    "evaluate {others_task}",
    "evaluate {others_engine}",
    "report",
    "report /nowhere",
    "report {thesis}",
    "report {unfinished} --out {new}",
    "report {half_summary} --out {new}",
    "report {no_metrics} --out {new}",
    "report {foreign_metrics} --out {new}",
    "report {empty_summary} --out {new}",
    "report {run} {run} --out {new}",
    "report {run} --reference nosuch --out {new}",
    "report {run} --out {file}",
    "report {damaged_comparison} --out {new}",
    "config nosuch",
    "config --env cube-tripple",
    "config --preset smoke --set skills.alpha=x",
    "picture nosuch --out {new}.png",
    "picture antmaze-medium",
    "data",
    "data nosuch",
    "data info /nowhere.npz",
    "data info {file}",
    "data info {truncated}",
    "data info {thesis}",
    "data check {truncated} --env antmaze-medium",
    "data check {sound} --env nosuch",
    "data check {sound} --env antmaze-medium --horizon 0",
    "data fetch nosuch",
    "data make antmaze-medium --out {new}.npz",
    "data make nosuch --out {new}.hdf5",
    "data make antmaze-medium --out {folder}",
    "data make antmaze-medium --out {file}/new.hdf5",
    "data make antmaze-medium --out {new}.hdf5 --transitions 3",
    "data make antmaze-medium --out {new}.hdf5 --seed 4294967296",
    "data make antmaze-medium --out {new}.hdf5 --degraded-share 2",
    "data make antmaze-medium --out {new}.hdf5 --mix expert=0.5,nosuch=0.5",
]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders and files by what is wrong with them; ``new`` is not there."""
    root = tmp_path_factory.mktemp("bad")
    found = {name: root / name for name in ("new", "run", "thesis", "file", "comparison", "truncated.npz")}
    toy.run(found["run"])
    found["thesis"].mkdir()
    (found["thesis"] / "thesis.tex").write_text("all of it")
    found["file"].write_text("not a folder")
    content = SOUND.read_bytes()
    found["truncated"] = found.pop("truncated.npz")
    found["truncated"].write_bytes(content[: len(content) // 2])
    found["sound"] = SOUND
    found["folder"] = root / "folder.hdf5"
    found["folder"].mkdir()
    comparison.create(found["comparison"], {"qdos": "env: antmaze-medium-task1\n"})
    damaged: dict[str, tuple[str, str | None]] = {
        "unfinished": ("summary.json", None),
        "half_summary": ("summary.json", '{"env": '),
        "empty_summary": ("summary.json", "{}"),
        "no_metrics": ("metrics.csv", None),
        "foreign_metrics": ("metrics.csv", "a,b\n1,2\n"),
        "no_yaml": ("config.yaml", None),
        "foreign_yaml": ("config.yaml", "pizza: 3\n"),
    }
    for name, (file, text) in damaged.items():
        found[name] = shutil.copytree(found["run"], root / name)
        (found[name] / file).unlink()
        if text is not None:
            (found[name] / file).write_text(text)
    written = to_yaml(load_config("antmaze-medium", "smoke"))
    elsewhere = {
        "others_task": written.replace("env: antmaze-medium\n", "env: reacher-task1\n"),
        "others_engine": written.replace("physics: auto\n", "physics: mjx-warp\n"),
    }
    for name, text in elsewhere.items():
        assert text != written
        found[name] = shutil.copytree(found["run"], root / name)
        (found[name] / "config.yaml").write_text(text)
    found["damaged_comparison"] = shutil.copytree(found["comparison"], root / "damaged_comparison")
    (found["damaged_comparison"] / "comparison.json").write_text('{"methods"')
    return found


def content(root: Path) -> dict[str, str]:
    """Every file and folder with its content's hash; locks are no content."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for path in sorted(root.rglob("*"))
        if path.name != ".lock"
    }


@pytest.mark.parametrize(
    ("main", "command"),
    [*((train_main, command) for command in TRAIN), *((main, command) for command in OTHERS)],
    ids=[*(f"train {command}" for command in TRAIN), *OTHERS],
)
def test_one_line_and_nothing_changed(
    main: object,
    command: str,
    places: dict[str, Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    root = places["run"].parent
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    monkeypatch.chdir(tmp_path)
    before = content(root)
    try:
        code = main(shlex.split(command.format(**places)))  # type: ignore[operator]
    except SystemExit as stop:
        code = stop.code
    err = capsys.readouterr().err
    assert code == 2, err
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and len(lines[0]) > 20, err
    assert content(root) == before
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".lock"]


@pytest.mark.parametrize(
    "command", ["train.py --env antmaze-huge --preset smoke", "-m qdos_brax report {half_summary}"]
)
def test_so_does_the_real_program(command: str, places: dict[str, Path]) -> None:
    arguments = shlex.split(command.format(**places))
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1, done


def test_so_does_an_opengl_that_mujoco_cannot_load(tmp_path: Path) -> None:
    """It fails inside ``import mujoco``, so in a process of its own."""
    arguments = [sys.executable, "train.py", *shlex.split(START), "--out", str(tmp_path / "run")]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "MUJOCO_GL": "nonsense"}
    done = subprocess.run(arguments, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done
    assert "MUJOCO_GL is 'nonsense'" in done.stderr and done.stderr.endswith("unset it\n"), done
