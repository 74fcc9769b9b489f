#!/usr/bin/env bash
# safetensors: the same arrays with the same metadata, saved twice by one process, are two different files.
#
# Versions: safetensors 0.8.0 (CPython 3.11 and newer), the newest on 2026-12-01; reported upstream as
# https://github.com/safetensors/safetensors/issues/584. Behaviour: tensors are written in a fixed order, but the
# texts of ``metadata`` in one that changes from call to call, and ``metadata()`` gives them back in yet another,
# whatever the dict's order was. Without metadata, or with one text, all files are alike. So a checksum of the file
# does not say whether two exports of one model are the same, and a content-addressed store keeps both. What helps: a
# single text that holds everything as JSON, or the header written anew with its names sorted (the numbers' offsets
# count from its end, so that they may stay).
# Output seen:
#   metadata of 0 texts: 16 files, all alike, of 80 bytes
#   metadata of 1 texts: 16 files, all alike, of 112 bytes
#   metadata of 12 texts: 16 files, not all alike, of 256 bytes
#   read back, all of them hold the same arrays and texts: True
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "safetensors==0.8.0" "numpy==2.4.6"
"$work/venv/bin/python" - "$work/file" <<'PY' | tee "$work/seen.txt"
import sys

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

for count in (0, 1, 12):
    texts = {f"name{index:02}": str(index) for index in range(count)}
    files = [save({"a": np.arange(2.0)}, texts or None) for _ in range(16)]
    sizes = {len(file) for file in files}
    said = "all alike" if len(set(files)) == 1 else "not all alike"
    print(f"metadata of {count} texts: 16 files, {said}, of {' '.join(map(str, sorted(sizes)))} bytes")

same = True
for file in files:
    with open(sys.argv[1], "wb") as out:
        out.write(file)
    with safe_open(sys.argv[1], framework="numpy") as found:
        same &= found.metadata() == texts and np.array_equal(found.get_tensor("a"), np.arange(2.0))
print(f"read back, all of them hold the same arrays and texts: {same}")
PY
diff "$work/seen.txt" - <<'SEEN'
metadata of 0 texts: 16 files, all alike, of 80 bytes
metadata of 1 texts: 16 files, all alike, of 112 bytes
metadata of 12 texts: 16 files, not all alike, of 256 bytes
read back, all of them hold the same arrays and texts: True
SEEN
echo "as described"
