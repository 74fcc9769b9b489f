#!/usr/bin/env bash
# jax: the persistent compilation cache keeps nothing of a program that contains a pure_callback, and says nothing.
#
# Versions: jax and jaxlib 0.10.2 (CPU). Behaviour: with a cache folder, no lower bound on compile time and none on size,
# a plain program is written to the cache and found by a second process. A program that is the same but for one
# pure_callback is compiled again by every process: no entry, no warning at the default log level. A simulator called
# back from inside a training step (MuJoCo C from jit) makes the largest programs of a run uncacheable.
# Output seen, twice (first and second process):
#   entries after the plain program 1, after the one with a callback 1
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
cat > "$work/probe.py" <<'PY'
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

folder = pathlib.Path(sys.argv[1])
jax.config.update("jax_compilation_cache_dir", str(folder))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def program(x):
    return jnp.sin(x) * 2


def program_with_callback(x):
    return jax.pure_callback(lambda x: np.sin(np.asarray(x)), jax.ShapeDtypeStruct(x.shape, x.dtype), x) * 2


def entries():
    return len([path for path in folder.glob("jit_program*-cache")])


x = jnp.ones(4)
jax.block_until_ready(jax.jit(program)(x))
plain = entries()
jax.block_until_ready(jax.jit(program_with_callback)(x))
print(f"entries after the plain program {plain}, after the one with a callback {entries()}")
PY
mkdir "$work/cache"
for _ in 1 2; do "$work/venv/bin/python" "$work/probe.py" "$work/cache" | tee -a "$work/seen.txt"; done
diff "$work/seen.txt" - <<'SEEN'
entries after the plain program 1, after the one with a callback 1
entries after the plain program 1, after the one with a callback 1
SEEN
echo "as described"
