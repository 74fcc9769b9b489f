#!/usr/bin/env bash
# JAX on CPU: the mean of many rows has other last bits on one core than on two.
#
# Versions: jax and jaxlib 0.10.2, numpy 2.3.4. Behaviour: XLA cuts a sum over many numbers into as many parts as the
# process has cores, and adds in another order. A mean over the rows of a large array differs by the last bits between
# one core and two of the same machine (`taskset`, or a container with fewer cores), while one of a minibatch's 128
# rows, and a minibatch's products of matrices, are equal to the bit. So statistics of a dataset made by
# `jnp.mean(data, axis=0)` are all it takes for a seed to end elsewhere on another number of cores. float64 in NumPy on
# the host does not depend on them. XLA_FLAGS=--xla_cpu_multi_thread_eigen=false changes nothing. Needs two cores, and
# Linux (os.sched_setaffinity).
# Output seen:
#   mean of 128 rows: the same on 1 and 2 cores
#   product of 128 x 128 matrices: the same on 1 and 2 cores
#   mean of 40000 rows: differs on 1 and 2 cores
#   the same without threads of Eigen: differs on 1 and 2 cores
#   float64 in NumPy: the same on 1 and 2 cores
set -euo pipefail
unset PYTHONPATH XLA_FLAGS
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.3.4"
cat > "$work/sums.py" <<'PY'
import hashlib
import os
import sys

os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])])
import jax
import jax.numpy as jnp
import numpy as np


def bits(name, x):
    print(f"{name}|{hashlib.sha256(np.asarray(x).tobytes()).hexdigest()}")


rows = jax.random.normal(jax.random.key(0), (40_000, 40))
square = jax.random.normal(jax.random.key(1), (128, 128))
mean = jax.jit(lambda x: x.mean(axis=0))
bits("mean of 128 rows", mean(rows[:128]))
bits("product of 128 x 128 matrices", jax.jit(lambda x: x @ x)(square))
bits("mean of 40000 rows", mean(rows))
bits("float64 in NumPy", np.asarray(rows, np.float64).mean(axis=0))
PY
cat > "$work/compare.py" <<'PY'
import os
import subprocess
import sys


def found(cores, **variables):
    command = [sys.executable, sys.argv[1], str(cores)]
    lines = subprocess.check_output(command, text=True, env=os.environ | variables).splitlines()
    return dict(line.split("|") for line in lines)


if len(os.sched_getaffinity(0)) < 2:
    sys.exit("this finding needs two cores")
one, two = found(1), found(2)
flag = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
same = {name: one[name] == two[name] for name in one}
threads = found(1, **flag)["mean of 40000 rows"] == found(2, **flag)["mean of 40000 rows"]
order = ["mean of 128 rows", "product of 128 x 128 matrices", "mean of 40000 rows"]
for name, equal in [*((name, same[name]) for name in order), ("the same without threads of Eigen", threads),
                    ("float64 in NumPy", same["float64 in NumPy"])]:
    print(f"{name}: {'the same' if equal else 'differs'} on 1 and 2 cores")
expected = [True, True, False]
assert [same[name] for name in order] == expected and not threads and same["float64 in NumPy"], "a release has changed"
PY
"$work/venv/bin/python" "$work/compare.py" "$work/sums.py"
echo "as described"
