"""Trained networks and their weight files: plain arrays with a JSON header, shipped with this package."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from qdos_brax.errors import UserError
from qdos_brax.files import write_arrays
from qdos_brax.nn.networks import DiagonalGaussian


@dataclass(frozen=True)
class Actor:
    """Hold a trained network.

    Attributes:
        hidden: hidden widths.
        dim: width of the output.
        params: the network's parameters.
        header: how it was trained and how well it performs.
    """

    hidden: tuple[int, ...]
    dim: int
    params: Any
    header: dict[str, Any]

    def mode(self, observation: jax.Array) -> jax.Array:
        """Return the squashed mean[..., dim] in [-1, 1]."""
        return jnp.tanh(DiagonalGaussian(self.hidden, self.dim).apply(self.params, observation)[0])


def shipped(name: str) -> Path:
    """Return the path of the weights called ``name`` in this package."""
    return Path(str(resources.files("qdos_brax.collection.experts") / f"{name}.npz"))


def write_actor(path: Path, actor: Actor) -> None:
    """Write the weights as plain arrays with a JSON header; errors as ``files.write_arrays``."""
    flat = {"/".join(k): np.asarray(v) for k, v in traverse_util.flatten_dict(actor.params).items()}
    header = {**actor.header, "hidden": list(actor.hidden)}
    write_arrays(path, {**flat, "header": np.frombuffer(json.dumps(header).encode(), np.uint8)})


def read_actor(path: Path) -> Actor:
    """Read the weights in ``path``.

    Raises:
        UserError: the file is missing or holds no weights.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            flat = {tuple(k.split("/")): file[k] for k in file.files if k != "header"}
        params = traverse_util.unflatten_dict(flat)
        last = max(params["params"]["MLP_0"])  # Dense_0, Dense_1, ..
        dim = params["params"]["MLP_0"][last]["bias"].shape[0] // 2
        return Actor(tuple(header.pop("hidden")), dim, params, header)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise UserError(
            f"cannot read the expert's weights in {path} ({error}); "
            "train them with `python -m qdos_brax.collection.experts.train`"
        ) from error
