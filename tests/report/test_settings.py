"""Which members of run folders make one setting, and what it is called."""

from __future__ import annotations

from pathlib import Path

import pytest

from qdos_brax.errors import UserError
from qdos_brax.report.reading import read_study
from tests.report.folders import vary, write_run

pytestmark = pytest.mark.quick


def labels(*paths: Path) -> dict[str, int]:
    return {s.label: sum(map(len, s.members.values())) for s in read_study(paths).settings}


def test_seeds_of_separate_commands_belong_together(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", success=[0.5], seeds=[0])
    b = write_run(tmp_path / "b", success=[0.7, 0.9], seeds=[1, 2])
    assert labels(a, b) == {"qdos": 3}


def test_members_are_told_apart_by_what_was_varied(tmp_path: Path) -> None:
    scan = write_run(tmp_path / "scan", success={0.1: [0.5, 0.6], 0.3: [0.7, 0.8]})
    supe = write_run(tmp_path / "supe", "supe", [0.1, 0.2])
    assert labels(scan, supe) == {"qdos, alpha 0.1": 2, "qdos, alpha 0.3": 2, "supe": 2}
    other = write_run(tmp_path / "other", "supe", [0.3], more="values: {estimator: iql}\n")
    assert labels(supe, other) == {"supe, estimator graph": 2, "supe, estimator iql": 1}
    data = write_run(tmp_path / "data", "supe", [0.3], data="e" * 64)
    assert labels(supe, data) == {"supe, data dddddddd": 2, "supe, data eeeeeeee": 1}


def test_seeds_on_several_sets_of_data_are_pooled_when_asked(tmp_path: Path) -> None:
    """One learner's seed may then be there once per set; what else was varied still makes a setting."""
    a = write_run(tmp_path / "a", success={0.1: [0.5, 0.6], 0.3: [0.7, 0.8]})
    b = write_run(tmp_path / "b", success={0.1: [0.1], 0.3: [0.3]}, data="e" * 64, more="data: {seed: 1}\n")
    apart = {s.label for s in read_study([a, b]).settings}
    assert apart == {f"qdos, data seed {data}, alpha {alpha}" for data in (0, 1) for alpha in (0.1, 0.3)}
    study = read_study([a, b], pooled=["data.seed"])
    means = {s.label: sum(m.success for ms in s.members.values() for m in ms) for s in study.settings}
    assert means == pytest.approx({"qdos, alpha 0.1": 1.2, "qdos, alpha 0.3": 1.8})
    assert study.notes == []
    with pytest.raises(UserError, match=r"both hold qdos, alpha 0\.1, seed 0 on antmaze-medium-task1"):
        read_study([a, write_run(tmp_path / "c", success={0.1: [0.1], 0.3: [0.3]})], pooled=["data.seed"])
    with pytest.raises(UserError, match=r"--pool data\.sed: no key by which settings .* did you mean 'data\.seed'\?"):
        read_study([a, b], pooled=["data.sed"])
    other = write_run(tmp_path / "d", success={0.1: [0.1], 0.3: [0.3]}, data="f" * 64)  # a file of one's own
    assert [s.label for s in read_study([a, other], pooled=["data"]).settings] == ["qdos, alpha 0.1", "qdos, alpha 0.3"]


def test_keys_that_end_alike_are_named_in_full(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", more="values: {updates: 5}\nguide: {updates: 6}\nlabels: {rnd_features: 8}\n")
    b = write_run(tmp_path / "b", more="values: {updates: 6}\nguide: {updates: 7}\nlabels: {rnd_features: 9}\n")
    assert {label.removeprefix("qdos, ") for label in labels(a, b)} == {
        "values updates 5, rnd features 8, guide updates 6",
        "values updates 6, rnd features 9, guide updates 7",
    }


def test_tasks_have_alphas_of_their_own(tmp_path: Path) -> None:
    """A key that differs only between tasks was not varied: one row, as in the paper's table."""
    a = write_run(tmp_path / "a", success={0.3: [0.5]})
    b = write_run(tmp_path / "b", success={0.1: [0.9]}, env="antsoccer-arena-task4")
    assert labels(a, b) == {"qdos": 2}


def test_runs_that_differ_in_much_are_named_by_their_folders(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a")
    b = write_run(
        tmp_path / "b", more="values: {n_step: 3, max_nodes: 9}\nlabels: {rnd_features: 8}\neval: {episodes: 3}\n"
    )
    assert labels(a, b) == {f"qdos, run {a}": 1, f"qdos, run {b}": 1}


def test_settings_of_a_scan_of_many_keys_have_names_of_their_own(tmp_path: Path) -> None:
    scan = write_run(tmp_path / "a", success={0.1: [0.5], 0.3: [0.7]})
    vary(scan, kl_weight=[1.0, 2.0], latent_box=[2.0, 3.0], advantage_temperature=[0.5, 4.0])
    own = {
        "kl weight 1, advantage temperature 0.5, alpha 0.1, latent box 2",
        "kl weight 2, advantage temperature 4, alpha 0.3, latent box 3",
    }
    assert set(labels(scan)) == {f"qdos, {named}" for named in own}
    other = write_run(tmp_path / "b", success=[0.5])
    assert set(labels(scan, other)) == {f"qdos, run {other}", *(f"qdos, run {scan}, {named}" for named in own)}
