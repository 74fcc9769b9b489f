"""The page of a nine-member scan in a real browser, if there is one: mouse, filter, switches, and widths."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qdos_brax.report.video import webp
from qdos_brax.report.write import write_report
from tests.report.browser import CHROMIUM, DRIVER, Browser, browser, running_driver
from tests.report.folders import write_run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no Chromium with its driver (Debian: chromium-driver)"),
]
ALPHAS = (0.1, 0.2, 0.3)
MEMBERS = {f"qdos, alpha {alpha}, seed {seed}" for alpha in ALPHAS for seed in range(3)}
MEANS = {f"qdos, alpha {alpha}" for alpha in ALPHAS}
# The chart of success over the steps; the name of every curve in it that can be seen.
CURVES = "[...document.querySelectorAll('.box')].find(b => b.querySelector('h3')?.textContent === 'success')"
SHOWN = f"return {CURVES}.querySelector('.chart').data.filter(t => t.visible && t.mode).map(t => t.name)"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of three alphas by three seeds, all analysed and filmed, with one frozen and 600 segments each."""
    folder = tmp_path_factory.mktemp("page")
    goals = [100, None, 300, 400, 500, 600, None, 800, 900]
    success = {0.1: [0.5, 0.6, 0.4], 0.2: [0.7, 0.8, 0.9], 0.3: [0.3, 0.2, 0.1]}
    run = write_run(folder / "scan", success=success, first_goals=goals, frozen=[8])
    rng = np.random.default_rng(0)
    segments, grid = 600, [(4.0 * x, 4.0 * y) for x in range(8) for y in range(8) if x in (0, 7) or y in (0, 7)]
    arrays: dict[str, Any] = {
        "members": np.arange(9), "goal": np.array([20.0, 20.0]), "walls": np.asarray(grid),
        "return": rng.normal(size=segments), "gain": rng.normal(size=segments),
        "quality": rng.integers(0, 4, segments), "part": rng.integers(0, 6, segments),
        "part_names": np.asarray(["none", "microwave", "kettle", "bottom burner", "light switch", "several"]),
        "quality_names": np.asarray(["navigate", "noisy", "wander", "fail"]),
    }  # fmt: skip
    # Scenes that drift, and films of them as large as those of episodes (150 kB).
    scene = np.kron(rng.integers(0, 255, (8, 10, 3)).astype(np.uint8), np.ones((30, 32, 1), np.uint8))
    scenes = np.stack([np.roll(scene, i, axis=1) for i in range(60)])
    film = np.frombuffer(webp(scenes, fps=10), np.uint8)
    assert film.size > 140_000
    for i in range(9):
        own = {
            "weight": np.exp(rng.normal(size=segments)), "tsne": rng.normal(size=(segments, 2)),
            "grid": 4 + rng.normal(size=(25, 61, 2)).cumsum(axis=1) / 4,
            "between": 4 + rng.normal(size=(9, 61, 2)).cumsum(axis=1) / 4,
            "path": 4 + rng.normal(size=(1001, 2)).cumsum(axis=0) / 9, "left": np.linspace(30, 0, 1001),
            "latents": rng.normal(size=(50, 8)), "tsne_episode": rng.normal(size=(50, 2)),
            "parts": np.arange(1001)[:, None] > [100, 400, 600, 900],
            "frame_steps": np.linspace(0, 1000, 6).astype(int), "frames": scenes[:6],
            "film": film, "film_speed": np.float32(8),
        }  # fmt: skip
        arrays |= {f"{i}/{name}": array for name, array in own.items()}
    np.savez_compressed(run / "inside.npz", **arrays)
    return write_report([run], folder / "out").page


@pytest.fixture(scope="session")
def driver() -> Iterator[str]:
    """The address of a running chromedriver."""
    with running_driver() as address:
        yield address


@pytest.fixture(scope="module", params=[1280, 420], ids="width {}".format)
def walked(request: pytest.FixtureRequest, driver: str, page: Path) -> Iterator[tuple[Browser, int]]:
    """A window of some width in which the page was read to its end, and that width."""
    with browser(driver, request.param) as window:
        window.open(page)
        _walk(window)
        yield window, request.param


def test_it_opens_at_once(page: Path, driver: str) -> None:
    """A limit of wall time, for an idle machine."""
    assert page.stat().st_size < 10_000_000
    with browser(driver, 1280) as window:
        assert window.open(page) < 3


def test_page_in_a_browser(page: Path, driver: str) -> None:
    with browser(driver, 1280) as window:
        window.open(page)
        _walk(window)
        _hover(window)
        _filter(window)
        _switch_colours(window)
        _play_film(window)
        assert window.console() == []
        requested = window.requested()
        assert requested and {address[:5] for address in requested} <= {"file:", "data:", "blob:"}


@pytest.mark.parametrize("part", ["document.documentElement", "...document.querySelectorAll('.chart')"])
def test_nothing_hangs_over_the_edge(walked: tuple[Browser, int], part: str) -> None:
    window, width = walked
    wide = f"return [{part}].filter(x => x.scrollWidth > x.clientWidth + 1).length"
    assert window.run(wide) == 0
    assert window.run("return innerWidth") == width


def test_reading_the_page_to_its_end_gives_no_error(walked: tuple[Browser, int]) -> None:
    assert walked[0].console() == []


def test_an_error_or_a_request_would_be_seen(tmp_path: Path, driver: str) -> None:
    (tmp_path / "wrong.html").write_text("<img src='http://127.0.0.1:9/x.png'><script>nonsense()</script>")
    with browser(driver, 1280) as window:
        window.open(tmp_path / "wrong.html")
        assert any("nonsense" in line for line in window.console())
        assert any(address.startswith("http:") for address in window.requested())


@pytest.mark.parametrize("width", [1280, 420])
def test_the_page_can_be_used_without_a_mouse_or_eyes(page: Path, driver: str, width: int) -> None:
    with browser(driver, width) as window:
        window.open(page)
        for lacking in ("img:not([alt])", ".chart:not([aria-label])", "nav:not([aria-label])", "th:not([scope])"):
            assert window.run("return document.querySelectorAll(arguments[0]).length", lacking) == 0, lacking
        # What scrolls sideways can be reached and named; headings do not skip a level.
        sideways = "[...document.querySelectorAll('.scroll')]"
        assert window.run(f"return {sideways}.every(x => x.tabIndex === 0 && x.ariaLabel)")
        levels = window.run("return [...document.querySelectorAll('h1, h2, h3')].map(h => Number(h.tagName[1]))")
        assert levels[0] == 1 and all(after - before <= 1 for before, after in itertools.pairwise(levels))


def _walk(window: Browser) -> None:
    """Read the page down to its end, with every part unfolded: a chart is drawn when it comes near."""
    window.run("document.querySelectorAll('main details').forEach(part => { part.open = true; })")
    window.wait("const next = charts.find(c => !c.dataset.drawn); next?.scrollIntoView(); return !next")
    window.wait("return charts.every(chart => chart.querySelector('.main-svg'))")


def _hover(window: Browser) -> None:
    """Point at the mean of alpha 0.2 half way: it shows its value, the mean of 0.35, 0.4 and 0.45."""
    at = window.run(
        f"const chart = {CURVES}.querySelector('.chart'); chart.scrollIntoView({{block: 'center'}});"
        "const box = chart.getBoundingClientRect(), full = chart._fullLayout;"
        "return [box.x + full.xaxis._offset + full.xaxis.d2p(2000), box.y + full.yaxis._offset + full.yaxis.d2p(0.4)]"
    )
    window.point(at[0] - 30, at[1] - 30)
    window.point(*at)
    shown = window.wait(f"return {CURVES}.querySelector('.hoverlayer').textContent")
    assert "40%" in shown and "alpha 0.2" in shown, shown


def _filter(window: Browser) -> None:
    crossed = {"qdos, alpha 0.3, seed 2 (frozen)"}  # twice: its curve, and the cross at its end
    everyone = (MEMBERS - {"qdos, alpha 0.3, seed 2"}) | MEANS | crossed
    assert set(window.run(SHOWN)) == everyone
    window.click(".filter summary")
    window.click("input[data-member]")
    assert set(window.run(SHOWN)) == everyone - {"qdos, alpha 0.1, seed 0"}
    assert window.run("return document.getElementById('shown').textContent") == "8 of 9"
    window.click("input[data-setting]")
    assert {name for name in everyone if "alpha 0.1" not in name} == set(window.run(SHOWN))
    # Charts that only show hidden members disappear as a whole: their latents, maps and episodes.
    assert window.run("return [...document.querySelectorAll('.box[hidden]')].length") >= 4
    window.click("input[data-setting]")
    assert set(window.run(SHOWN)) == everyone
    assert window.run("return [...document.querySelectorAll('.box[hidden]')].length") == 0
    window.click(".filter summary")


def _play_film(window: Browser) -> None:
    """Start and stop a film with the keyboard: it is decoded, and the picture stands still again."""
    window.run("document.querySelector('[data-play]').focus()")
    shown = "const film = document.querySelector('.film img'); return film.complete && film.naturalWidth && film.src"
    still = window.wait(shown)
    assert still.startswith("data:image/jpeg")
    window.press(" ")
    assert window.wait(shown).startswith("data:image/webp")
    assert window.run("return document.querySelector('[data-play]').textContent") == "Stop"
    window.press(" ")
    assert window.wait(shown) == still


def _switch_colours(window: Browser) -> None:
    """Press one button: it changes the colour of every method's latents."""
    colour = "return document.querySelector('section:has([data-choice]) .chart').data[0].marker.color[0]"
    before = window.run(colour)
    assert before in (0, 1, 2, 3)
    window.click("button[data-choice=return]")
    assert window.run(colour) != before
    pressed = window.run(
        "return [...document.querySelectorAll('[data-choice][aria-pressed=true]')].map(b => b.textContent)"
    )
    assert pressed == ["return"]
