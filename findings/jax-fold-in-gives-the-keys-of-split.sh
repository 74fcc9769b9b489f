#!/usr/bin/env bash
# jax: fold_in(key, i) is one of the keys of split(key, n), bit for bit, and the checker of key reuse does not see it.
#
# Versions: jax and jaxlib 0.10.2 (CPU; the default since 0.5, jax_threefry_partitionable=True). Behaviour: a key made
# beside those of a split, split(key, 3) here and fold_in(key, 1) there, is split(key, 3)[1]: whatever is drawn from both
# is the same, and what is drawn from their splits again. Nor do splits of different lengths differ: split(key, 5) begins
# with split(key, 3). The documentation of either function does not say so ("statistically safe for producing a stream of
# new pseudo-random values"), jax.debug_key_reuse(True) raises nothing, and with the earlier implementation
# (jax_threefry_partitionable=False) all these keys differ: code that relied on it became wrong by an update.
# A key beside those of a split is one more of them, split(key, n + 1)[n], which leaves the first n as they are.
# Output seen:
#   partitionable True: fold_in(key, 1) is split(key, 3)[1] True, split(key, 5) begins with split(key, 3) True
#   partitionable False: fold_in(key, 1) is split(key, 3)[1] False, split(key, 5) begins with split(key, 3) False
#   with the checker of key reuse: no error, numbers from both keys equal True
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY' | tee "$work/seen.txt"
import jax
import numpy as np


def same(a, b):
    return np.array_equal(jax.random.key_data(a), jax.random.key_data(b))


for partitionable in (True, False):
    with jax.threefry_partitionable(partitionable):
        key = jax.random.key(3)
        three, five = jax.random.split(key, 3), jax.random.split(key, 5)
        beside, prefix = same(jax.random.fold_in(key, 1), three[1]), same(five[:3], three)
    print(
        f"partitionable {partitionable}: fold_in(key, 1) is split(key, 3)[1] {beside}, "
        f"split(key, 5) begins with split(key, 3) {prefix}"
    )

with jax.debug_key_reuse(True):
    key = jax.random.key(3)
    _, second = jax.random.split(key)
    numbers = jax.random.normal(second, (4,)), jax.random.normal(jax.random.fold_in(key, 1), (4,))
print(f"with the checker of key reuse: no error, numbers from both keys equal {np.array_equal(*numbers)}")
PY
diff "$work/seen.txt" - <<'SEEN'
partitionable True: fold_in(key, 1) is split(key, 3)[1] True, split(key, 5) begins with split(key, 3) True
partitionable False: fold_in(key, 1) is split(key, 3)[1] False, split(key, 5) begins with split(key, 3) False
with the checker of key reuse: no error, numbers from both keys equal True
SEEN
echo "as described"
