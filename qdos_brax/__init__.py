"""QDOS: advantage-weighted quality-diversity skills from offline data, then online learning over them."""

import importlib.util
import sys
import warnings
from pathlib import Path

__version__ = "0.1.0"


def _prefer_own_envs() -> None:
    """Make ``import envs`` find the package beside this one, whatever folder of that name comes earlier on the path.

    Many projects of this field have a folder ``envs`` of their own.

    Raises:
        ImportError: another ``envs`` is imported already.
    """
    own = Path(__file__).parents[1] / "envs" / "__init__.py"
    loaded = sys.modules.get("envs")
    if loaded is not None:
        if getattr(loaded, "__file__", None) != str(own):
            raise ImportError(
                f"another package named envs is imported already, from {_place(loaded.__spec__)}, where qdos_brax "
                "needs its own; rename that folder, or import qdos_brax first"
            )
        return
    found = importlib.util.find_spec("envs")
    if found is not None and found.origin == str(own):
        return
    spec = importlib.util.spec_from_file_location("envs", own, submodule_search_locations=[str(own.parent)])
    assert spec is not None and spec.loader is not None  # of a file that ends in .py there always is one
    sys.modules["envs"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if found is not None and sys.argv[0] != "-m":  # no code of the user's asks for theirs in python -m qdos_brax
        warnings.warn(
            f"envs means the package of qdos_brax from here on, not {_place(found)}; rename that folder to use both",
            stacklevel=2,
        )


def _place(spec: object) -> str:
    """Return where a package lies; one without ``__init__.py`` has no file."""
    places = list(getattr(spec, "submodule_search_locations", None) or [])
    return str(getattr(spec, "origin", None) or ", ".join(map(str, places)))


_prefer_own_envs()
