"""README and docs: links lead somewhere, commands parse, generated pages are fresh, the README stays short."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs.tools import concept_pictures, configuration_page
from qdos_brax.commands.main import main_parser
from qdos_brax.commands.train import configs_from_args, train_parser
from qdos_brax.config import load_config
from qdos_brax.config.methods import METHODS

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
FENCED = re.compile(r"^```[^\n]*\n(.*?)^```", re.M | re.S)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def code(page: Path) -> list[str]:
    """The lines of a page's fenced blocks."""
    return "".join(FENCED.findall(page.read_text(encoding="utf-8"))).splitlines()


def commands(start: str) -> list[str]:
    return [line.removeprefix(start) for page in PAGES for line in code(page) if line.startswith(start)]


def anchors(page: Path) -> set[str]:
    """The anchors that a code host gives a page's headings."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name} links to {link}"
        assert not anchor or anchor in anchors(target), f"{page.name} links to {link}"


def in_nav(entry: Any) -> list[str]:
    """The files of an entry of mkdocs.yml's nav."""
    if isinstance(entry, str):
        return [entry]
    return [name for part in (entry.values() if isinstance(entry, dict) else entry) for name in in_nav(part)]


def test_every_page_is_in_the_sites_nav_once() -> None:
    nav = in_nav(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    assert sorted(nav) == sorted(path.name for path in DOCS.glob("*.md"))


def test_pages_of_the_site_link_only_to_what_it_holds() -> None:
    for page in DOCS.glob("*.md"):
        assert not [link for link in LINK.findall(page.read_text(encoding="utf-8")) if link.startswith("..")], page


def test_the_page_of_the_configuration_is_that_of_the_schema() -> None:
    """Else: python docs/tools/configuration_page.py."""
    assert (DOCS / "configuration.md").read_text(encoding="utf-8") == configuration_page.page()


@pytest.mark.parametrize("name", concept_pictures.PICTURES)
def test_the_pictures_of_the_concepts_are_those_of_their_script(name: str) -> None:
    """Else: python docs/tools/concept_pictures.py."""
    assert (DOCS / name).read_text(encoding="utf-8") == concept_pictures.PICTURES[name]()


def test_the_method_of_the_page_can_be_added() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", (DOCS / "add-a-method.md").read_text(encoding="utf-8"), re.M | re.S)
    before = dict(METHODS)
    try:
        exec(block, {})
        config = load_config("antmaze-medium", "smoke", {"method": "diverse"})
        assert METHODS["diverse"].information and not METHODS["diverse"].weighted
        assert config.skills.alpha == 0.5 and config.labels.offline_reward == "data"
    finally:
        METHODS.clear()
        METHODS.update(before)


@pytest.mark.parametrize("line", commands("python train.py "))
def test_training_commands_can_be_typed(line: str) -> None:
    args = train_parser().parse_args(shlex.split(line, comments=True))
    assert args.resume or configs_from_args(args)


@pytest.mark.parametrize("line", commands("python -m qdos_brax "))
def test_other_commands_can_be_typed(line: str) -> None:
    words = shlex.split(line, comments=True)
    assert callable(main_parser(words).parse_args(words).run)


def test_readme_is_short_and_has_two_commands_that_set_up() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1200
    assert len([line for line in code(ROOT / "README.md") if "-m venv" in line]) == 2


def test_every_page_is_linked_from_the_readme() -> None:
    linked = {link.partition("#")[0] for link in LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))}
    assert {str(page.relative_to(ROOT)) for page in PAGES[1:]} <= linked


def test_every_result_names_its_command() -> None:
    text = (ROOT / "results" / "README.md").read_text(encoding="utf-8")
    names = [path.name + ("/" if path.is_dir() else "") for path in (ROOT / "results").iterdir()]
    assert [name for name in names if name != "README.md" and f"`{name}`" not in text] == []
