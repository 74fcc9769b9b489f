"""Reading run folders, what is drawn and tabled of them, and one clear line for what cannot be reported."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from qdos_brax.commands import main as commands
from qdos_brax.report.next_step import advise
from qdos_brax.report.reading import read_study
from qdos_brax.report.result_sections import learning_section, summary_section
from qdos_brax.report.series import curves, mean_over_steps, scans, surfaces
from qdos_brax.report.summary_cards import summary_cards
from qdos_brax.report.tables import success_csv, tables
from qdos_brax.report.write import write_report
from qdos_brax.runs import comparison
from tests.report.folders import vary, write_run

pytestmark = pytest.mark.quick


def test_tables_by_hand(tmp_path: Path) -> None:
    goals = [10_000, 10_000, 20_000]
    runs = [
        write_run(tmp_path / "q", success=[0.9, 0.95, 1.0], first_goals=goals),
        write_run(tmp_path / "s", "supe", [0.2, 0.4, 0.95], first_goals=[5_000, None, None]),
    ]
    success, detail, goal = tables(read_study(runs))
    assert success.rows == [["qdos", "95 ± 5"], ["supe", "52 ± 39"]]
    # 0.9 beats two of three, 0.95 beats two and ties with one, 1.0 beats all: (2 + 2.5 + 3) / 9.
    assert detail.rows[0][-1].startswith("0.83 [") and detail.rows[1][-1] == "-"
    assert detail.rows[0][3] == "95 [90, 100]"
    # Linear from a quarter of the end at 1,000 steps to the end at 4,000: 0.625 of the ends, whose mean is 0.95.
    assert detail.header[4] == "area (%)" and detail.rows[0][4] == "59 ± 3"
    assert goal.rows == [["qdos", "13,333 ± 5,774 (3/3)"], ["supe", "5,000 (1/3)"]]
    assert "| qdos | 95 ± 5 |" in success.markdown()
    assert success.text().splitlines()[2] == f"{'qdos':6}  {'95 ± 5':>20}"
    report = write_report(runs, tmp_path / "out")
    with (tmp_path / "out" / "table1.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["mean"] for row in rows] == ["0.95", "0.516667"] and rows[0]["improvement"] == f"{7.5 / 9:.6g}"
    assert rows[1]["improvement"] == "" and rows[0]["reference"] == "supe"
    assert rows[0]["area"] == f"{0.625 * 0.95:.6g}" and rows[0]["score"] == ""
    table2 = (tmp_path / "out" / "table2.csv").read_text().splitlines()
    assert table2[1:] == ["antmaze-medium-task1,qdos,3,3,13333.3,5773.5", "antmaze-medium-task1,supe,3,1,5000,"]
    assert {file.name for file in report.files} == {file.name for file in (tmp_path / "out").iterdir()}


def test_curves_meet_the_members_in_the_middle(tmp_path: Path) -> None:
    study = read_study([write_run(tmp_path / "a", success=[0.4, 0.8])])
    (curve,) = curves(study, "antmaze-medium-task1", "eval/success")
    assert curve.steps.tolist() == [1000, 2000, 4000]
    np.testing.assert_allclose(curve.mean, [0.15, 0.3, 0.6])
    # Two members: the interval's ends are the members themselves, for each is drawn twice in a quarter of the cases.
    np.testing.assert_allclose([curve.low, curve.high], [[0.1, 0.2, 0.4], [0.2, 0.4, 0.8]])


def test_a_score_has_panels_of_its_own_where_there_is_one(tmp_path: Path) -> None:
    plain, scored = write_run(tmp_path / "a"), write_run(tmp_path / "b", env="kitchen-mixed-task1")
    metrics = scored / "metrics.csv"
    header, *lines = metrics.read_text().splitlines()
    rows = [f"{line},{0.25 * index if ',online,' in line else ''}" for index, line in enumerate(lines)]
    metrics.write_text("\n".join([header + ",eval/score", *rows]) + "\n")
    names = {
        path: [figure.title for figure in learning_section(read_study([path])).figures] for path in (plain, scored)
    }
    assert names == {plain: ["success", "return"], scored: ["success", "score", "return"]}
    (curve,) = curves(read_study([scored]), "kitchen-mixed-task1", "eval/score")
    np.testing.assert_allclose(curve.mean, [0.5, 0.75, 1.0])


def test_where_nobody_does_the_whole_task_its_parts_rank_the_settings(tmp_path: Path) -> None:
    """A score is the table's, the cards', the charts' and the scans' as long as every success is 0."""
    kitchen = {"env": "kitchen-mixed-task1"}
    scan = write_run(tmp_path / "a", success={0.1: [0, 0], 0.3: [0, 0]}, scores=[0.5, 0.75, 0.25, 0.5], **kitchen)
    study = read_study([scan])
    _, score, *_ = tables(study)
    assert "score" in score.title and score.rows == [["qdos, alpha 0.1", "38 ± 18"], ["qdos, alpha 0.3", "62 ± 18"]]
    best, _, _, went, _ = summary_cards(study)
    assert (best.title, best.value) == ("Best score", "qdos, alpha 0.3") and "the whole by nobody" in best.text
    assert went.value == "still rising"
    (varied,) = scans(study)
    assert varied.measure == "score" and varied.lines[0].mean.tolist() == [0.375, 0.625]
    (chart,) = summary_section(study).figures
    assert chart.layout["xaxis"]["title"]["text"] == "score at the last evaluation"
    assert [trace["x"] for trace in chart.data][:3] == [[0.625], [0.75], [0.5]]
    whole = write_run(tmp_path / "b", success=[0.05], scores=[0.2], **kitchen)
    study = read_study([whole])
    assert summary_cards(study)[0].title == "Best success" and tables(study)[1].rows == [["qdos", "20"]]
    rows = list(csv.DictReader(success_csv(study).splitlines()))
    assert rows[0]["score"] == "0.2" and rows[0]["score_std"] == ""


def test_a_curve_of_one_evaluation_has_no_area(tmp_path: Path) -> None:
    (member,) = read_study([write_run(tmp_path / "a")]).runs[0].members
    assert mean_over_steps(member) == 0.625 * 0.5
    alone = [row for row in member.rows if row["env_steps"] != "1000" and row["env_steps"] != "2000"]
    assert np.isnan(mean_over_steps(dataclasses.replace(member, rows=alone)))


def test_a_task_of_parts_has_a_table_of_them(tmp_path: Path) -> None:
    """Two seeds: the last evaluation counts, and each misses another part."""
    plain, parted = write_run(tmp_path / "a"), write_run(tmp_path / "b", success=[0, 0], env="kitchen-mixed-task1")
    metrics = parted / "metrics.csv"
    header, *lines = metrics.read_text().splitlines()
    done = [",", ",", "0.25,0.25", "0.5,0.25"]  # two rows of the skills, which have none, and the earlier evaluations
    cells = [*done, "1,0", *done, "0.05,0.9"]
    rows = [f"{line},{cell}" for line, cell in zip(lines, cells, strict=True)]
    metrics.write_text("\n".join([f"{header},eval/done/kettle,eval/done/light", *rows]) + "\n")
    *_, parts = tables(read_study([plain, parted]))
    assert parts.header == ["method", "seed", "kettle", "light"] and "kitchen-mixed-task1" in parts.title
    assert parts.rows == [["qdos", "0", "100", "0"], ["qdos", "1", "5", "90"]]
    assert len(tables(read_study([plain]))) == 3


def test_scan_by_hand(tmp_path: Path) -> None:
    study = read_study([write_run(tmp_path / "a", success={0.3: [0.7, 0.9], 0.1: [0.5, None]})])
    (scan,) = scans(study)
    (line,) = scan.lines
    assert scan.key == "skills.alpha" and line.values == [0.1, 0.3] and line.label == "qdos"
    assert line.mean.tolist() == pytest.approx([0.5, 0.8]) and [len(group) for group in line.members] == [1, 2]


def test_values_drawn_at_random_make_no_line(tmp_path: Path) -> None:
    """No two settings differ in one key alone, so their points are not joined; the axis is logarithmic."""
    run = write_run(tmp_path / "a", success={0.1: [0.5], 0.2: [0.7], 0.3: [0.9]})
    study = read_study([vary(run, kl_weight=[0.02, 3.0, 0.5])])
    weight, alpha = scans(study)
    assert (alpha.key, weight.key) == ("skills.alpha", "skills.kl_weight")
    assert not alpha.log_scale and weight.log_scale and not weight.lines[0].joined
    assert weight.lines[0].values == [0.02, 0.5, 3.0] and weight.lines[0].mean.tolist() == [0.5, 0.9, 0.7]
    assert surfaces(study) == []


def test_every_combination_of_two_makes_a_surface(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a", success={0.1: [0.2, 0.4], 0.3: [0.6, 0.8]})
    # The second seed becomes the other value, so that each of the four combinations has one member.
    study = read_study([vary(run, kl_weight=[1.0, 1.0, 2.0, 2.0])])
    (surface,) = surfaces(study)
    assert surface.keys == ("skills.kl_weight", "skills.alpha") and (surface.x, surface.y) == ([1, 2], [0.1, 0.3])
    assert surface.mean.tolist() == [[0.2, 0.4], [0.6, 0.8]]
    assert [len(scan.lines) for scan in scans(study)] == [2, 2] and scans(study)[0].lines[0].joined


def test_summary_cards_by_hand(tmp_path: Path) -> None:
    q = write_run(tmp_path / "q", success=[0.9, 0.8, 1.0], first_goals=[10_000, 20_000, 30_000])
    s = write_run(tmp_path / "s", "supe", [0.2, 0.4, 0.3], first_goals=[5_000, None, None])
    best, sure, fastest, went, time = summary_cards(read_study([q, s]))
    assert best.value == "qdos" and "90 % (95 % interval of the mean: 80 to 100 %)" in best.text
    assert sure.value == "better than the next" and "probability 1.00" in sure.text and "too narrow" in sure.text
    # One seed of supe was faster, but two of its three never reached the goal.
    assert fastest.value == "qdos" and fastest.text.startswith("20,000 ") and "3 of 3" in fastest.text
    assert went.value == "learned"
    assert time.value == "13.3 min" and time.text == "6 members: 2.2 min each, 45 % of it online."
    even = write_run(tmp_path / "e", "supe", [0.9, 0.8, 1.0])
    best, sure, fastest, *_ = summary_cards(read_study([q, even]))
    assert "2 settings" in best.value and sure.value == "no clear difference"
    assert sure.text.startswith("No difference was found between qdos and supe (95 % interval of the probability")
    nothing = write_run(tmp_path / "n", success=[0.0])
    best, sure, fastest, never, time = summary_cards(read_study([nothing]))
    assert (best.value, fastest.value) == ("none", "none") and "nothing to compare" in sure.text
    assert time.text.startswith("1 member, ")
    assert never.value == "never reached the goal" and "--steps 8000" in never.text


@pytest.mark.parametrize(
    ("success", "verdict", "says"),
    [
        ([0, 0, 0, 0], "never reached the goal", "data check"),
        ([0, 0.2, 0.5, 0.95], "learned", "--method"),
        ([0, 0.2, 0.5, 0.8], "still rising", "By 30 points in the last quarter: try --steps 800"),
        ([0, 0.9, 0.8, 0.5], "fell back", "at 90 % before"),
        ([0, 0.6, 0.6, 0.62], "levelled off", "benchmarks/skills.py"),
    ],
)
def test_advice_by_hand(success: list[float], verdict: str, says: str) -> None:
    found = advise(np.array([100.0, 200, 300, 400]), np.array(success), "antmaze-medium-task1")
    assert found.verdict == verdict and says in found.text


def test_a_smoke_run_is_not_advised_to_go_on(tmp_path: Path) -> None:
    run = write_run(tmp_path / "s", success=[0.0])
    text = (run / "summary.json").read_text()
    (run / "summary.json").write_text(text.replace('"preset": "paper"', '"preset": "smoke"'))
    (card,) = [card for card in summary_cards(read_study([run])) if card.title == "How it went"]
    assert card.value == "a smoke run" and "without --preset smoke" in card.text and "--steps" not in card.text


def test_a_reader_is_warned(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", success=[0.5, None])
    b = write_run(tmp_path / "b", "supe", [0.5], data="e" * 64, more="high_level: {env_steps: 9000}\n")
    c = write_run(tmp_path / "c", "supe", [0.5], seeds=[4], data="e" * 64, more="high_level: {env_steps: 9000}\n")
    text = (c / "summary.json").read_text()
    (c / "summary.json").write_text(text.replace('"ok"', '"nan"'))
    notes = read_study([a, b, c]).notes
    assert len(notes) == 4
    assert "the members differ in env steps (200000: qdos; 9000: supe)" in notes[0]
    assert "the members differ in data (dddddddd: qdos; eeeeeeee: supe)" in notes[1]
    assert "a (qdos, seed 1) was never evaluated" in notes[2] and "c (supe, seed 4) was frozen" in notes[3]
    assert "unequal numbers of seeds (qdos: 2, supe: 1)" in read_study([a, b]).notes[2]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ("none", "is not a run folder"),
        ("unfinished", "has not finished; continue it with: python train.py --resume"),
        ("empty", "has no rows"),
        ("no metrics", "cannot read"),
        ("cut summary", "cannot read"),
        ("foreign summary", "does not match metrics.csv or is damaged"),
        ("fewer rows", "does not match metrics.csv or is damaged"),
        ("cut provenance", "cannot read"),
        ("wrong config", "unknown key 'sed', did you mean 'seed'?"),
        ("twice", "was given twice"),
        ("copy", "both hold qdos, seed 0 on antmaze-medium-task1; leave one out"),
        ("comparison", "has not finished; continue it with"),
        ("reference", "--reference spue: no such method was run, did you mean 'supe'?"),
        ("file in the way", "--out"),
    ],
)
def test_what_cannot_be_reported_is_one_line(
    broken: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = write_run(tmp_path / "run"), tmp_path / "out"
    arguments = [str(run)]
    summary, metrics = run / "summary.json", run / "metrics.csv"
    match broken:
        case "none":
            arguments = [str(tmp_path)]
        case "unfinished":
            summary.unlink()
        case "empty":
            metrics.write_text(metrics.read_text().splitlines()[0] + "\n")
        case "no metrics":
            metrics.unlink()
        case "cut summary":
            summary.write_text(summary.read_text()[:50])
        case "foreign summary":
            summary.write_text("{}")
        case "fewer rows":
            metrics.write_text(
                "\n".join(line for line in metrics.read_text().splitlines() if line[0] != "0") + "\n1,,,,,,,,,\n"
            )
        case "cut provenance":
            (run / "run.json").write_text("{")
        case "wrong config":
            (run / "config.yaml").write_text("sed: 3\n")
        case "twice":
            arguments.append(f"{run}/")
        case "copy":
            arguments.append(str(shutil.copytree(run, tmp_path / "copy")))
        case "comparison":
            comparison.create(tmp_path / "both", {"qdos": "env: antmaze-medium-task1\n"})
            arguments = [str(tmp_path / "both")]
        case "reference":
            arguments += [str(write_run(tmp_path / "s", "supe")), "--reference", "spue"]
        case "file in the way":
            out.touch()
    try:
        code = commands.main(["report", *arguments, "--out", str(out)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    lines = capsys.readouterr().err.strip().splitlines()
    assert code == 2 and len(lines) == 1 and message in lines[0]
    assert not out.is_dir()
