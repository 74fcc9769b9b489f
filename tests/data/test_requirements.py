"""Data that lacks something: refused in one line where training cannot do without, trained on where it can."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from qdos_brax.analysis import inside
from qdos_brax.analysis.embedding import embedded
from qdos_brax.config.methods import METHODS
from qdos_brax.config.methods import settings as method_settings
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import to_device
from qdos_brax.data.requirements import unmet
from qdos_brax.errors import UserError
from qdos_brax.methods.build import build_context, build_phases
from qdos_brax.methods.low_level_kinds import value_phase
from tests.point import PointEnv, bound, point_config, point_dataset, run_phase

HORIZON = 5


def rows(count: int) -> dict[str, np.ndarray]:
    """The first rows of the plane, as one episode."""
    arrays = {name: value for name, value in vars(point_dataset(8)).items() if isinstance(value, np.ndarray)}
    return {name: value[:count].copy() for name, value in arrays.items()} | {"ends": np.arange(count) == count - 1}


def lacking(what: str) -> Dataset:
    """Data of the plane that lacks something."""
    arrays = rows({"one segment": HORIZON, "and one row more": HORIZON + 1, "a row less": HORIZON - 1}.get(what, 30))
    if what in ("constant observations", "everything"):
        for name in ("observations", "next_observations", "qpos"):
            arrays[name][:] = 0.3
    if what in ("constant actions", "everything"):
        arrays["actions"][:] = 0.3
    if what in ("no success", "everything"):
        arrays["rewards"][:], arrays["masks"][:] = -1.0, 1.0
    if what == "success alone":
        arrays["rewards"][:], arrays["masks"][:] = 0.0, 0.0
    return Dataset(**arrays, source="the plane")


def config_of(method: str, **values: Any) -> Any:
    horizon = method_settings(method, "antmaze").get("skills.horizon", HORIZON)
    return point_config(**{"method": method, "skills.horizon": horizon} | values)


@pytest.mark.parametrize("value", [0.0, 0.3, -1e6])
def test_constant_observations_are_one_line_with_the_setting_that_helps(value: float) -> None:
    """The graph of states has nothing to go by; it ended in an IndexError."""
    data = lacking("constant observations")
    data.observations[:] = data.next_observations[:] = value
    with pytest.raises(UserError, match=r"the plane: observations are the same in every row.*estimator=iql") as error:
        build_context(config_of("qdos"), PointEnv(), data)
    assert "\n" not in str(error.value)
    for method in METHODS:
        values = {"values.estimator": "iql"} if method == "qdos" else {}
        assert unmet(data, PointEnv(), config_of(method, **values)) == []


def test_observations_that_vary_outside_of_segments_alone_are_constant() -> None:
    data = lacking("constant observations")
    data.ends[26] = True  # the last three rows are no segment
    data.observations[27:] = data.next_observations[27:] = 1.0
    assert len(unmet(data, PointEnv(), config_of("qdos"))) == 1
    data.observations[3] = 1.0
    assert unmet(data, PointEnv(), config_of("qdos")) == []


def test_too_few_rows_name_the_longest_episode() -> None:
    (line,) = unmet(lacking("a row less"), PointEnv(), config_of("qdos"))
    assert "no episode has 5 steps, the length of a segment (longest 4): use --set skills.horizon=N" in line
    for what in ("one segment", "and one row more"):
        assert unmet(lacking(what), PointEnv(), config_of("qdos")) == []
    for method in METHODS:  # those without skills take single transitions, or shorter chunks of actions
        met = unmet(lacking("a row less"), PointEnv(), config_of(method)) == []
        assert met == (config_of(method).skills.horizon <= 4)


def test_rollouts_need_the_whole_state() -> None:
    for missing, says in ((("qpos", "qvel"), "no qpos and qvel"), (("qvel",), "no qvel")):
        data = replace(lacking("nothing"), **dict.fromkeys(missing))
        (line,) = unmet(data, PointEnv(), config_of("qdos"))
        assert line.startswith(says) and "skills.mi_rollout=logged" in line
        outcome = {"skills.mi_encoder": "outcome"}  # what logged states cannot tell
        assert unmet(data, PointEnv(), config_of("qdos", **outcome))[0].endswith("use --alpha 0")
        assert unmet(data, PointEnv(), config_of("qdos", **{"skills.mi_rollout": "logged"})) == []
        assert unmet(data, PointEnv(), config_of("supe")) == []
        assert unmet(data, PointEnv(), config_of("qdos", **{"skills.alpha": 0.0})) == []  # nothing is rolled out
        assert len(unmet(data, PointEnv(), config_of("qdos", **{"skills.alpha": [0.0, 0.3]}))) == 1


@pytest.mark.parametrize("estimator", ["graph", "iql"])
@pytest.mark.parametrize(
    "what", ["nothing", "constant actions", "no success", "success alone", "one segment", "and one row more"]
)
def test_values_and_weights_are_finite_on_data_that_lacks(
    what: str, estimator: str, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_of("qdos", **{"values.estimator": estimator, "values.updates": 4})
    dataset = lacking(what)
    data, _ = to_device(dataset, HORIZON)
    phase = bound(value_phase(config, PointEnv(), dataset.ends), config, data)
    _, _, artifacts = run_phase(phase, jax.random.split(jax.random.key(0), 1), {})
    assert artifacts["advantage"].shape == (1, len(data.starts)) and np.isfinite(artifacts["advantage"]).all()
    said = capsys.readouterr().err if estimator == "graph" else ""
    assert ("rewards do not tell success apart, every reward is 0" in said) == (what == "success alone" and said != "")
    assert ("no success in the data, every reward is -1" in said) == (said != "" and not (dataset.masks == 0).any())


def test_a_bound_on_slowness_that_nothing_meets_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    config, dataset = config_of("qdos", **{"values.slowness": 1.0}), lacking("nothing")
    data, _ = to_device(dataset, HORIZON)
    phase = bound(value_phase(config, PointEnv(), dataset.ends), config, data)
    run_phase(phase, jax.random.split(jax.random.key(0), 1), {})
    line = next(line for line in capsys.readouterr().err.splitlines() if "slowness" in line)
    assert "no feature of the observations has an autocorrelation of values.slowness=1 over 5 steps" in line
    assert "--set values.slowness=N" in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "values", "what"),
    [
        *(("qdos", {}, what) for what in ("success alone", "constant actions", "one segment", "and one row more")),
        ("qdos", {"values.estimator": "iql"}, "everything"),
        *((method, {}, "everything") for method in METHODS if method != "qdos"),
    ],
)
def test_every_method_trains_to_its_end_on_data_that_lacks(method: str, values: Mapping[str, Any], what: str) -> None:
    config = config_of(method, **values)
    context = build_context(config, PointEnv(), lacking(what))
    artifacts: dict[str, Any] = {}
    for phase in build_phases(context):
        keys = jax.random.split(jax.random.key(0), 1)
        _, history, artifacts = run_phase(bound(phase, config, context.data), keys, artifacts)
        unknown = {name for name, value in history[-1].items() if not np.isfinite(np.asarray(value, float)).all()}
        assert unknown <= {"first_goal_step", "train/success"}, phase.name


@pytest.mark.parametrize("size", [1, 2, 8])
@pytest.mark.parametrize("count", [1, 2, 6, 40])
@pytest.mark.parametrize("constant", [True, False])
def test_latents_that_hardly_differ_are_shown_as_far_as_they_can_be(size: int, count: int, constant: bool) -> None:
    """Of equal latents scikit-learn's t-SNE dies, and the finished run with it; of one dimension it refuses."""
    latents = np.random.default_rng(0).normal(size=(count, size)).astype(np.float32)
    if constant:
        latents[:] = latents[0]
    found = embedded(latents, latents[:0])
    shown = count >= 6 and not constant
    assert found.keys() == ({"tsne", "tsne_episode"} if shown else set())
    for array in (*found.values(), inside._grid(latents), inside._between(latents)):
        assert np.isfinite(array).all()
