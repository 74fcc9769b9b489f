"""Names of public data sets and their addresses."""

from __future__ import annotations

from qdos_brax.data import sources


def test_names_and_addresses() -> None:
    """OGBench's two addresses and file names; D4RL's as in its infos.py."""
    found = sources.find("antmaze-large-navigate-v0")
    assert found is not None
    assert found.urls == (
        "https://rail.eecs.berkeley.edu/datasets/ogbench/antmaze-large-navigate-v0.npz",
        "https://huggingface.co/datasets/zhouzypaul/ogbench_datasets/resolve/main/antmaze-large-navigate-v0.npz",
    )
    large = sources.find("antmaze-large-diverse-v2")
    assert large is not None and large.urls == (
        "http://rail.eecs.berkeley.edu/datasets/offline_rl/ant_maze_v2/"
        "Ant_maze_hardest-maze_noisy_multistart_True_multigoal_True_sparse_fixed.hdf5",
    )
    for name in (
        "humanoidmaze-giant-stitch-v0-val",
        "antsoccer-arena-navigate-v0",
        "scene-play-v0",
        "kitchen-mixed-v0",
    ):
        assert sources.find(name) is not None
    for name in ("antmaze-giant-explore-v0", "antsoccer-large-navigate-v0", "antmaze-large-navigate", "../a-v0"):
        assert sources.find(name) is None
