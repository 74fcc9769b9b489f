"""Write docs/configuration.md from the schema of the configuration: ``python docs/tools/configuration_page.py``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from qdos_brax.commands.config import accepted, written
from qdos_brax.config.schema import Config, get_field, groups, leaves
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

`--set KEY=VALUE` takes any key; where a list makes a scan, several values are trained as one program
([Scans](scans.md)). A list of any other key makes one program after another."""


def page() -> str:
    """Return the page."""
    return "\n\n".join([HEAD, *_sections()]) + "\n"


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
