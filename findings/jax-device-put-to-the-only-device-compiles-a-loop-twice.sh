#!/usr/bin/env bash
# JAX: constants put on the one device there is, by name, make a training loop's program compile twice.
#
# Versions: jax and jaxlib 0.10.2, numpy 2.3.4. Behaviour: `jax.device_put(x, device)` commits an array to its device,
# also where there is no other one, and jit takes a committed argument for another kind than one that is not. A state
# fresh from `jnp.zeros` is not committed, what a program makes of it and of committed constants is: the second call of
# the same step, with the same shapes, dtypes and device, compiles the whole step again, and the folder of compiled
# programs keeps both. `jax.device_put(x)` and `jnp.asarray(x)` commit nothing. Whoever loads learned weights with a
# device named and goes on training on fresh optimiser states waits for two compilations (20 s each for an actor-critic's
# loop on two cores). `state.committed` tells; numpy arrays in place of the committed ones, or a first state that is put
# on the device by name as well, need one.
# Output seen:
#   constants by jnp.asarray: programs after each call 1 1 1, kept 1
#   constants by device_put: programs after each call 1 1 1, kept 1
#   constants by device_put to the only device: programs after each call 1 2 2, kept 2
#   the state put there too: programs after each call 1 1 1, kept 1
set -euo pipefail
unset PYTHONPATH XLA_FLAGS
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.3.4"
cat > "$work/loop.py" <<'PY'
import os
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

way, folder = sys.argv[1:]
jax.config.update("jax_compilation_cache_dir", folder)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
(device,) = jax.devices()
rows = np.arange(8, dtype=np.float32)
constants = {"jnp.asarray": jnp.asarray, "device_put": jax.device_put}.get(way, partial(jax.device_put, device=device))(rows)


@partial(jax.jit, donate_argnums=0)
def step(state, constants):
    return 0.9 * state + constants.sum()


state = jnp.zeros(4)
if way == "the state put there too":
    state = jax.device_put(state, device)
programs = []
for _ in range(3):
    state = step(state, constants)
    programs.append(step._cache_size())
kept = sum(name.startswith("jit_step") and name.endswith("-cache") for name in os.listdir(folder))
name = way if way.startswith("the") else f"constants by {way}"
print(f"{name}: programs after each call {' '.join(map(str, programs))}, kept {kept}")
PY
number=0
for way in "jnp.asarray" "device_put" "device_put to the only device" "the state put there too"; do
    number=$((number + 1))
    mkdir "$work/kept$number"
    JAX_PLATFORMS=cpu "$work/venv/bin/python" "$work/loop.py" "$way" "$work/kept$number" | tee -a "$work/seen"
done
cat > "$work/expected" <<'SEEN'
constants by jnp.asarray: programs after each call 1 1 1, kept 1
constants by device_put: programs after each call 1 1 1, kept 1
constants by device_put to the only device: programs after each call 1 2 2, kept 2
the state put there too: programs after each call 1 1 1, kept 1
SEEN
diff "$work/expected" "$work/seen" || { echo "a release has changed" >&2; exit 1; }
echo "as described"
