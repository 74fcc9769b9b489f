"""Write docs/configuration.md from the schema of the configuration: ``python docs/tools/configuration_page.py``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from qdos_brax.commands.config import accepted, written
from qdos_brax.config import load_config
from qdos_brax.config.layers import families
from qdos_brax.config.methods import METHODS
from qdos_brax.config.methods import settings as published_settings
from qdos_brax.config.rules import convert
from qdos_brax.config.schema import Config, get, get_field, groups, leaves
from qdos_brax.files import write_text

PAGE = Path(__file__).resolve().parents[1] / "configuration.md"
HEAD = """# Configuration

Every key of a run's `config.yaml`, with its default. This page is written by `python docs/tools/configuration_page.py`
from the schema (`qdos_brax/config/`); a test keeps it up to date.

A value comes from the highest layer that sets it, from below: the default here (the paper's), the task family's YAML
(`configs/`), the method's published values ([Methods](methods.md)), the preset, the flags, `--set`. What a key is on
your task, and which layer set it, says

```
python -m qdos_brax config skills.alpha --env antsoccer --method supe
```

`--set KEY=VALUE` takes any key (but `env`, `method` and `preset`, which have flags); where a list makes a
scan, several values are trained as one program ([Scans](scans.md)). A list of any other key makes one program
after another."""


SHRUNK = """## What preset cpu changes of the published methods

Every method has the values that its authors published ([Methods](methods.md)); preset `paper` keeps them.
Where these are not the configuration's own defaults, the table has the ones that preset `cpu` has made
smaller or moved, so that a run takes minutes on two cores; `--set KEY=VALUE` brings one back. Sizes that are
defaults shrink as well, such as the 32 proposals of `qc` (8) or the ten critics of `wsrl` (4): `python -m
qdos_brax config KEY --env TASK --method METHOD` has both."""


def page() -> str:
    """Return the page."""
    return "\n\n".join([HEAD, *_sections(), SHRUNK, "\n".join(_shrunk())]) + "\n"


def _shrunk() -> Iterator[str]:
    """Yield a table of the published values that preset cpu overrides: one row for families that have the same two."""
    yield "| method | key | published | preset cpu | task families |"
    yield "|---|---|---|---|---|"
    found: dict[tuple[str, ...], list[str]] = {}
    for method in METHODS:
        for family in families():
            config = load_config(family, "cpu", {"method": method})
            for key, value in published_settings(method, family).items():
                published, used = convert(key, value, get_field(key)), get(config, key)
                if published != used:
                    found.setdefault((method, key, written(published), written(used)), []).append(family)
    for (method, key, published, used), own in found.items():
        yield f"| {method} | `{key}` | `{published}` | `{used}` | {', '.join(own)} |"


def _sections() -> Iterator[str]:
    keys = [key for key, _ in leaves(Config)]
    yield "\n".join(["## The run as a whole", "", *_table([key for key in keys if "." not in key])])
    for name, meaning in groups().items():
        own = [key for key in keys if key.partition(".")[0] == name]
        yield "\n".join([f"## {name}", "", meaning, "", *_table(own)])


def _table(keys: list[str]) -> Iterator[str]:
    yield "| key | default | meaning | accepts |"
    yield "|---|---|---|---|"
    for key in keys:
        field = get_field(key)
        cells = (f"`{key}`", f"`{written(field.default)}`", field.metadata["meaning"], accepted(key))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    write_text(PAGE, page())
