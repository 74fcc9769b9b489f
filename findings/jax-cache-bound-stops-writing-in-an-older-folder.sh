#!/usr/bin/env bash
# JAX: a bound on the compilation cache stops all writing where the folder was filled without one.
#
# Versions: jax and jaxlib 0.10.2 (CPU), filelock 3.29.0. Behaviour: without jax_compilation_cache_max_size an entry of the
# persistent cache is one file, NAME-cache. With it, every write first reads the time of last use of all entries from
# NAME-atime beside them, which entries from before the bound do not have. The write fails, a warning says so, and the new
# program is not kept; so does every later write, until each old entry has been read once or is deleted. Programs that
# were in the folder are still found.
# It matters where someone bounds a cache that has grown for months.
# Output seen:
#   a new folder, bounded: kept
#   a folder that one program was written to without the bound: not kept (FileNotFoundError in a warning)
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6" "filelock==3.29.0"
cat > "$work/one.py" <<'PY'
import pathlib
import sys
import warnings

import jax
import jax.numpy as jnp

folder, bound, size = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
jax.config.update("jax_compilation_cache_dir", str(folder))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_compilation_cache_max_size", bound)
before = len(list(folder.glob("jit_f*-cache")))
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x), inline=False).lower(jnp.ones((size, size))).compile()
kept = len(list(folder.glob("jit_*-cache"))) > before and not caught
text = " ".join(str(w.message) for w in caught)
print("kept" if kept else "not kept", "FileNotFoundError" if "No such file" in text or "FileNotFound" in text else "")
PY
python="$work/venv/bin/python"
a_hundred_megabytes=100000000
new=$("$python" "$work/one.py" "$work/new" $a_hundred_megabytes 8)
"$python" "$work/one.py" "$work/older" -1 8 > /dev/null
older=$("$python" "$work/one.py" "$work/older" $a_hundred_megabytes 9)
echo "a new folder, bounded: $new"
echo "a folder that one program was written to without the bound: $older"
[ "${new% *}" = "kept" ] || [ "$new" = "kept " ]
[ "$older" = "not kept FileNotFoundError" ]
echo "as described"
