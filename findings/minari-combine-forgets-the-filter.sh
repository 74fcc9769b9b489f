#!/usr/bin/env bash
# Minari: a combination of filtered sets holds every episode again, has no seeds, and its images are no longer lossless.
#
# Versions: minari 0.5.4 (HDF5), gymnasium 1.4.0, h5py 3.16.0, pillow 13.0.0, numpy 2.4.6. Behaviour: filter_episodes
# and split_dataset give a MinariDataset whose length, iteration and samples are those of the chosen episodes.
# combine_datasets reads the files behind its sets, so that whatever was filtered out is back: the successes of two sets
# together are their failures as well (known: https://github.com/Farama-Foundation/Minari/pull/350). Besides, two things
# that go unsaid: seeds and reset options, which an episode is repeated from, are gone in the combination; and sets
# written with jpeg_encoding=False become one of JPEG, so that images from 32 x 32 on change their numbers. No warning.
# It matters to whoever trains on the best episodes of several sets, learns from pixels, or replays episodes by seed.
# What helps: buffers made by hand from each set's episodes and its storage.get_episode_metadata, and
# create_dataset_from_buffers(..., jpeg_encoding=False).
# Output seen:
#   minari 0.5.4: two sets of 3 episodes, 1 success each after the filter
#   sources: returns [1, 1], seeds [12, 12], lossless True
#   combine_datasets: returns [0, 0, 1, 0, 0, 1], seeds [None, None, None, None, None, None], lossless False
#   buffers by hand: returns [1, 1], seeds [12, 12], lossless True
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "minari[hdf5]==0.5.4" "gymnasium==1.4.0" "h5py==3.16.0" "pillow==13.0.0" \
  "numpy==2.4.6"
MINARI_DATASETS_PATH="$work/sets" "$work/venv/bin/python" -W ignore - <<'PY' | tee "$work/seen.txt"
from importlib.metadata import version

import minari
import numpy as np
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer

SPACES = {"observation_space": Box(0, 255, (32, 32, 3), np.uint8), "action_space": Box(-1, 1, (2,), np.float32)}
FRAME = np.zeros((32, 32, 3), np.uint8)
FRAME[10:13, 20:23] = 255, 0, 0  # a red ball on black


def episode(number):
    last = np.arange(4) == 3
    return EpisodeBuffer(
        seed=10 + number,
        options={"goal": number},
        observations=np.stack([FRAME] * 5),
        actions=np.zeros((4, 2), np.float32),
        rewards=1.0 * last * (number == 2),
        terminations=last & (number == 2),
        truncations=last & (number != 2),
    )


def write(name, buffers):
    return minari.create_dataset_from_buffers(name, buffers, jpeg_encoding=False, **SPACES)


def show(name, sets):
    found = [one for part in sets for one in part]
    infos = [info for part in sets for info in part.storage.get_episode_metadata(part.episode_indices)]
    assert all(("options" in info) == ("seed" in info) for info in infos)
    lossless = all((one.observations == FRAME).all() for one in found)
    print(f"{name}: returns {[int(one.rewards.sum()) for one in found]}, ", end="")
    print(f"seeds {[info.get('seed') for info in infos]}, lossless {lossless}")


every = [write(name, [episode(number) for number in range(3)]) for name in ("first-v0", "second-v0")]
chosen = [part.filter_episodes(lambda one: one.rewards.sum() > 0) for part in every]
assert all((len(part), len(kept)) == (3, 1) for part, kept in zip(every, chosen))
print(f"minari {version('minari')}: two sets of 3 episodes, 1 success each after the filter")
show("sources", chosen)
show("combine_datasets", [minari.combine_datasets(chosen, "both-v0")])
parts = ("observations", "actions", "rewards", "terminations", "truncations")
buffers = [
    EpisodeBuffer(seed=info["seed"], options=info["options"], **{name: getattr(one, name) for name in parts})
    for part in chosen
    for one, info in zip(part, part.storage.get_episode_metadata(part.episode_indices))
]
show("buffers by hand", [write("by-hand-v0", buffers)])
PY
diff "$work/seen.txt" <(sed -n '/^# Output seen/,/^set/s/^#   //p' "$0")
echo "as described"
