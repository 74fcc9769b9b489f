"""The real program: members in one process, over two devices and over two processes are the same, bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.runs.checkpoint import final_artifacts
from qdos_brax.runs.folder import RunFolder
from tests.runs.program import assert_same_run, free_port, launch

FLAGS = "--env antmaze-medium --preset smoke --method qdos --alpha 0.1,0.3 --seed 0,1"


def artifacts(path: Path) -> dict[str, Any]:
    """What the members have learned, by place in the tree."""
    folder = RunFolder(path)
    learned = final_artifacts(folder.checkpoints, configs.config_hash(configs.from_yaml(folder.config)))
    return {jax.tree_util.keystr(key): np.asarray(leaf) for key, leaf in jax.tree_util.tree_leaves_with_path(learned)}


def header(path: Path) -> str:
    return (path / "metrics.csv").read_text().splitlines()[0]


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_members_are_the_same_however_they_are_run(tmp_path: Path) -> None:
    flags = FLAGS.split()
    one, devices, hosts = (tmp_path / name for name in ("one", "devices", "hosts"))
    assert launch(tmp_path / "data-one", *flags, "--out", str(one), JAX_NUM_CPU_DEVICES="1").wait(900) == 0
    two_devices = launch(tmp_path / "data-devices", *flags, "--out", str(devices), JAX_NUM_CPU_DEVICES="2")
    assert two_devices.wait(900) == 0
    assert "over 2 devices" in (tmp_path / "data-devices" / "log").read_text()
    meet = f"--distributed --coordinator localhost:{free_port()} --processes 2 --process-id"
    together = [
        launch(tmp_path / f"data-{index}", *flags, "--out", str(hosts), *meet.split(), str(index)) for index in (0, 1)
    ]
    assert [process.wait(900) for process in together] == [0, 0]
    learned = artifacts(one)
    kernels = [leaf for key, leaf in learned.items() if "actor" in key and "kernel" in key]
    assert kernels and all(len({member.tobytes() for member in kernel}) == 4 for kernel in kernels)
    for path in (devices, hosts):
        assert header(path) == header(one)
        assert_same_run(path, one)
        found = artifacts(path)
        assert found.keys() == learned.keys()
        for key, leaf in learned.items():
            assert found[key].tobytes() == leaf.tobytes(), key
