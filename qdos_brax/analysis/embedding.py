"""The plane in which a page shows latents: t-SNE."""

from __future__ import annotations

import numpy as np
from sklearn.manifold import TSNE  # type: ignore[import-untyped]
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

_FEWEST = 6  # latents that are worth a picture
_SEED = 0
_ITERATIONS = 500  # another 500 lower the divergence by a thousandth


def embedded(latents: np.ndarray, decisions: np.ndarray) -> dict[str, np.ndarray]:
    """Return where t-SNE lays latents of the data and those of an episode, in one plane.

    They are laid out together, for t-SNE has no map that later points could follow.

    Args:
        latents: float[n, z], of segments of the data.
        decisions: float[K, z], of an episode's decisions.

    Returns:
        tsne: float32[n, 2].
        tsne_episode: float32[K, 2].
        Nothing of few latents, if all are the same, or if any is not finite.
    """
    everything = np.concatenate([latents, decisions])
    # Of equal ones scikit-learn dies: no exception.
    if len(everything) < _FEWEST or (everything == everything[0]).all() or not np.isfinite(everything).all():
        return {}
    everything = np.pad(everything, ((0, 0), (0, max(0, 2 - everything.shape[1]))))  # it begins with two components
    perplexity = min(30.0, (len(everything) - 1) / 3)
    with threadpool_limits(1):  # on few cores its threads can wait for each other without end
        places = TSNE(perplexity=perplexity, init="pca", max_iter=_ITERATIONS, random_state=_SEED).fit_transform(
            everything
        )
    return {"tsne": places[: len(latents)], "tsne_episode": places[len(latents) :]}
