"""Members in one program, in turn, over devices and over processes: the same members, whoever their company is."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.population import memory
from qdos_brax.population.members import Population
from qdos_brax.population.phase import even_chunks
from qdos_brax.runs import shares
from qdos_brax.runs.folder import RunFolder
from qdos_brax.runs.metrics import read_rows
from tests.runs.program import free_port

ROOT = Path(__file__).parents[2]
SHARED = np.linspace(-1, 1, 64, dtype=np.float32).reshape(8, 8)


def advance(state, hyper, shared):
    """A learner with what can go wrong: a typed key, a branch, a loop, a matmul, a whole number."""
    key, draw = jax.random.split(state["key"])
    x = jax.lax.cond(state["count"] % 2 == 0, lambda x: x @ shared, jnp.sin, state["x"])
    x = jax.lax.fori_loop(0, 3, lambda _, x: x + hyper["rate"] * jax.random.normal(draw, (8,)), x)
    return {"key": key, "x": x, "count": state["count"] + 1}, {"norm": jnp.sum(x**2)}


def start(key, _):
    return {"key": key, "x": jax.random.normal(key, (8,)), "count": jnp.zeros((), jnp.int32)}


def trained(seeds, per_program=0, devices=None, parked=False, steps=3):
    """(x[members, 8], norm[members, steps]) after some chunks."""
    hyper = {"rate": 0.1 + 0.01 * np.asarray(seeds, np.float32)}
    population = Population(hyper, per_program, devices, parked)
    state = population.program(start)(jax.vmap(jax.random.key)(jnp.asarray(seeds)), None)
    program, shared, norms = population.program(advance, carries=True), population.shared(jnp.asarray(SHARED)), []
    for _ in range(steps):
        state, info = program(state, population.hyper, shared)
        norms.append(np.asarray(info["norm"]))
    assert np.asarray(state["count"]).tolist() == [steps] * len(seeds)
    return np.asarray(state["x"]), np.stack(norms, axis=1)


@pytest.mark.parametrize("parked", [False, True])
def test_a_member_in_turn_is_what_it_is_alone(parked: bool) -> None:
    seeds = [3, 1, 4, 15, 9]
    for found, *alone in zip(trained(seeds, 1, parked=parked), *(trained([seed]) for seed in seeds), strict=True):
        np.testing.assert_array_equal(found, np.concatenate(alone))
    x, _ = trained(seeds, 1)
    assert len({row.tobytes() for row in x}) == len(seeds)


@pytest.mark.parametrize("per_program", [2, 3, 4])
def test_groups_of_any_size_train_every_member_once(per_program: int) -> None:
    seeds = [0, 1, 2, 3, 4]
    for found, together in zip(trained(seeds, per_program), trained(seeds), strict=True):
        np.testing.assert_allclose(found, together, rtol=1e-5, atol=1e-6)


def test_groups_are_equal_and_turns_share_one_program() -> None:
    population = Population({"rate": np.zeros(9)}, 8)
    assert (population.per_program, population.turns) == (5, 2)
    traced = []

    def counted(x, shared):
        traced.append(1)
        return x + shared

    program = Population({"rate": np.zeros(9)}, 1).program(counted)
    np.testing.assert_array_equal(program(jnp.arange(9.0), 1.0), np.arange(9.0) + 1)
    assert len(traced) == 1


DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_cpu_enable_async_dispatch", False)
import numpy as np
import envs
from qdos_brax.population.members import Population
from tests.population.test_population import trained

for seeds in ([0, 1], [0, 1, 2], [0, 1, 2, 3, 4]):
    for one, two in zip(trained(seeds, 1), trained(seeds, 1, jax.local_devices()), strict=True):
        np.testing.assert_array_equal(one, two)

env = envs.make("antmaze-medium", physics="mujoco")

def play(key, _):
    def body(state, key):
        return env.step(state, jax.random.uniform(key, (8,), minval=-1.0)), None
    return jax.lax.scan(body, env.reset(key), jax.random.split(key, 20))[0].pipeline_state.qpos

keys = jax.random.split(jax.random.key(0), 4)
one = Population({"rate": np.zeros(4)}, 1).program(play)(keys, None)
two = Population({"rate": np.zeros(4)}, 1, jax.local_devices()).program(play)(keys, None)
np.testing.assert_array_equal(one, two)

turns = Population({"rate": np.zeros(4)}, 1, jax.local_devices())
everywhere = turns.shared(np.arange(4.0))  # as what is made from the data set
np.testing.assert_array_equal(turns.program(lambda key, x, _: x + 1)(keys, everywhere, None), np.arange(4.0) + 1)
print("the same")
"""


def test_members_on_two_devices_are_those_of_one_and_mujoco_does_not_hang() -> None:
    done = subprocess.run(
        [sys.executable, "-c", DEVICES], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[-2] == "the same"


def test_memory_is_near_what_the_compiler_says() -> None:
    def step(state, shared):
        def body(x, _):
            return jnp.tanh(x @ shared) + x, None

        return jax.lax.scan(body, state, None, length=5)[0], jnp.zeros(())

    state, shared = jnp.zeros((1, 256, 512)), jnp.zeros((512, 512))
    program = Population({"rate": np.zeros(1)}).program(step, carries=True)
    compiled = program.compile(state, shared).memory_analysis()
    needed = memory.working_bytes(program, state, shared)
    assert 0.3 < needed / compiled.temp_size_in_bytes < 4


def test_a_plan_gives_every_member_a_core_and_fits() -> None:
    need, cores = memory.MemoryEstimate(shared=100, kept=10, working=20), [SimpleNamespace(platform="cpu")] * 4
    plan = memory.plan(need, 9, cores, 10_000, 0)  # type: ignore[arg-type]
    assert (len(plan.devices), plan.per_program) == (4, 1) and "4 at a time, in 3 turns, over 4 devices" in plan.line
    assert len(memory.plan(need, 3, cores, 10_000, 0).devices) == 3  # type: ignore[arg-type]
    tight = memory.plan(need, 9, cores, 400, 0)  # type: ignore[arg-type]  # 360 may be used: states 90, 120 per core
    assert len(tight.devices) == 2 and "too little" not in tight.line
    assert "too little" in memory.plan(need, 9, cores, 200, 0).line  # type: ignore[arg-type]
    together = memory.plan(need, 9, cores, 10_000, 5)  # type: ignore[arg-type]
    assert (len(together.devices), together.per_program) == (2, 5) and "all in one program" in together.line


def test_a_plan_fills_an_accelerator() -> None:
    need, one = memory.MemoryEstimate(shared=100, kept=10, working=20), [SimpleNamespace(platform="gpu")]
    assert memory.plan(need, 9, one, 10_000, 0).per_program == 9  # type: ignore[arg-type]
    assert memory.plan(need, 9, one, 10_000, 2).per_program == 2  # type: ignore[arg-type]
    assert memory.plan(need, 9, one * 3, 10_000, 0).per_program == 3  # type: ignore[arg-type]
    # Of 250 bytes 225 may be used, by the data and four members. The others' states can wait elsewhere, a group's not.
    waits, cramped = (memory.plan(need, 9, one, room, 0) for room in (250, 120))  # type: ignore[arg-type]
    assert waits.parked and waits.per_program == 4 and "in 3 turns" in waits.line and "too little" not in waits.line
    assert cramped.parked and cramped.per_program == 1 and "too little" in cramped.line


def test_shares_are_blocks_and_cover_everyone() -> None:
    members = list(range(7))
    blocks = [shares.members_of(members, index, 3) for index in range(3)]
    assert blocks == [[0, 1, 2], [3, 4], [5, 6]]


def test_a_process_that_stopped_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder.create(tmp_path / "run")
    shares.create(folder, 2, "env: antmaze-medium-task1\n")
    assert [share.path.name for share in shares.shares_of(folder)] == ["0", "1"]
    monkeypatch.setattr(shares, "_PATIENCE", 0.0)
    with pytest.raises(shares.UserError, match="has stopped before its end"):
        shares.await_end(shares.shares_of(folder)[1])


@pytest.mark.slow
def test_two_processes_train_the_members_of_one_and_go_on_after_a_kill(tmp_path: Path) -> None:
    dataset, sizes = (
        tmp_path / "data.hdf5",
        "--set policy.updates=40 --set policy.every_updates=20 --set eval.episodes=1",
    )
    make = f"-m qdos_brax data make antmaze-medium --out {dataset} --transitions 4000"
    subprocess.run([sys.executable, *make.split()], check=True, cwd=ROOT)
    flags = f"--env antmaze-medium --preset smoke --method bc --seed 0,1,2 {sizes} --members-per-program 1"
    flags += f" --dataset {dataset} --set run.checkpoint_seconds=0"
    assert launch(f"{flags} --out {tmp_path}/one").wait(280) == 0
    meet = f"--distributed --coordinator localhost:{free_port()} --processes 2 --process-id"
    second, first = (launch(f"{flags} --out {tmp_path}/two {meet} {index}") for index in (1, 0))
    part = tmp_path / "two" / "processes" / "0" / "metrics.csv"
    while not part.exists() or len(part.read_text().splitlines()) < 3:
        assert first.poll() is None
        time.sleep(0.02)
    first.kill()
    first.wait()
    assert second.wait(280) == 0  # it does not need the first one
    assert not (tmp_path / "two" / "summary.json").exists()
    assert launch(f"--resume {tmp_path}/two").wait(280) == 0
    one, two = (read_rows(tmp_path / name / "metrics.csv") for name in ("one", "two"))
    assert [row | {"sps": ""} for row in one] == [row | {"sps": ""} for row in two]
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("one", "two")]
    assert summaries[0]["members"] == summaries[1]["members"]


def launch(flags: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *flags.split()], cwd=ROOT)


@pytest.mark.parametrize(
    ("total", "most", "expected"),
    [(1_000, 500, (2, 500)), (600, 500, (2, 300)), (5, 500, (1, 5)), (601, 500, (2, 301)), (15, 2, (8, 2))],
)
def test_chunks_are_alike_and_hardly_pass_the_total(total: int, most: int, expected: tuple[int, int]) -> None:
    assert even_chunks(total, most) == expected
