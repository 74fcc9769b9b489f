"""The page in a real browser, where there is one: it draws, without an error or a request; hover and filter work."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest

from qdos_brax.report.page import write_page
from qdos_brax.report.study import read_study
from tests.report.folders import write_run

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

# Runs after the page's own scripts, and leaves what it saw in the document.
DRIVER = """<script>
const chart = document.querySelector(".chart");
const shown = () => chart.data.filter(trace => trace.visible !== false).map(trace => trace.name);
const seen = {drawn: performance.now(), requests: performance.getEntriesByType("resource").map(entry => entry.name)};
seen.charts = document.querySelectorAll(".chart .main-svg").length > 0;
seen.all = shown();
boxes[0].click();
seen.without_first = shown();
families[0].click();
seen.without_setting = shown();
families[0].click();
seen.again = shown();
document.querySelector("details .chart").closest("details").open = true;
const last = chart.data.length - 1;
setTimeout(() => {
  Plotly.Fx.hover(chart, [{curveNumber: last, pointNumber: 1}]);
  seen.hover = chart.querySelector(".hoverlayer").textContent;
  seen.folded = document.querySelector("details .chart .main-svg") !== null;
  const result = document.createElement("pre");
  result.id = "seen";
  result.textContent = JSON.stringify(seen);
  document.body.append(result);
}, 500);
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_page_in_a_browser(tmp_path: Path) -> None:
    run = write_run(tmp_path / "q", success={0.1: [0.5, 0.6], 0.3: [0.7, 0.8]}, first_goals=[100, None, 300, 400])
    write_page(read_study([run]), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    (tmp_path / "driven.html").write_text(page.replace("</body>", DRIVER + "</body>"), encoding="utf-8")
    dom, said = browse(tmp_path / "driven.html")
    assert "CONSOLE" not in said, said
    seen = json.loads(unescape(re.findall(r'<pre id="seen">(.*?)</pre>', dom)[0]))
    assert seen["requests"] == [] and seen["charts"] and seen["folded"]
    members = {f"qdos, alpha {alpha}, seed {seed}" for alpha in (0.1, 0.3) for seed in (0, 1)}
    means = {"qdos, alpha 0.1", "qdos, alpha 0.3"}
    assert set(seen["all"]) == members | means
    assert set(seen["without_first"]) == (members | means) - {"qdos, alpha 0.1, seed 0"}
    assert set(seen["without_setting"]) == {name for name in members | means if "0.3" in name}
    assert set(seen["again"]) == members | means
    assert "37.5%" in seen["hover"] or "0.375" in seen["hover"], seen["hover"]  # the mean of 0.35 and 0.4
    assert seen["drawn"] < 3000


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_an_error_in_the_page_would_be_seen(tmp_path: Path) -> None:
    (tmp_path / "wrong.html").write_text("<script>nonsense()</script>")
    assert "CONSOLE" in browse(tmp_path / "wrong.html")[1]


def browse(page: Path) -> tuple[str, str]:
    """The document after its scripts, and what the browser said."""
    assert CHROMIUM is not None
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=10000"]
    size = ["--window-size=1280,2000", f"--user-data-dir={page.parent / 'profile'}"]
    command = [CHROMIUM, *flags, *size, "--dump-dom", f"file://{page}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    return done.stdout, done.stderr
