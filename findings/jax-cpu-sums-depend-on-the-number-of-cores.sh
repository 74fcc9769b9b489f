#!/usr/bin/env bash
# JAX on CPU: the column sums of an array of some 50,000 numbers have other last bits on one core than on two.
#
# Versions: jax and jaxlib 0.10.2, numpy 2.3.4. Behaviour: XLA adds the rows of a large array in parts, as many as the
# process has cores, so in another order. Sums of 256 x 128 numbers are equal to the bit on one core and on two of the
# same machine (`taskset`, or a container with fewer cores), sums of 512 x 128 are not. The gradient of a bias is such a
# sum: a network learned from batches of 512 rows ends elsewhere on another number of cores, from the first step on,
# where one learned from 128 rows does not. So a seed names a run on one number of cores.
# XLA_FLAGS=--xla_cpu_multi_thread_eigen=false changes nothing; the same sum as a product with a row of ones does not
# depend on them. Needs two cores, and Linux (os.sched_setaffinity).
# Output seen:
#   sum of 256 x 128: the same on 1 and 2 cores
#   sum of 512 x 128: differs on 1 and 2 cores
#   gradient of 128 biases, batch of 128: the same on 1 and 2 cores
#   gradient of 128 biases, batch of 512: differs on 1 and 2 cores
#   ones @ (512 x 128): the same on 1 and 2 cores
#   sum of 512 x 128 without threads of Eigen: differs on 1 and 2 cores
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

rows = jax.random.normal(jax.random.key(0), (512, 128))
weight = jax.random.normal(jax.random.key(1), (128, 128))
column_sums = jax.jit(lambda x: x.sum(axis=0))
loss = lambda bias, weight, x: jnp.mean(jnp.tanh(x @ weight + bias) ** 2)
gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))
bias_gradient = lambda x: gradients(jnp.zeros(128), weight, x)[0]
for name, found in {
    "sum of 256 x 128": column_sums(rows[:256]),
    "sum of 512 x 128": column_sums(rows),
    "gradient of 128 biases, batch of 128": bias_gradient(rows[:128]),
    "gradient of 128 biases, batch of 512": bias_gradient(rows),
    "ones @ (512 x 128)": jax.jit(lambda x: jnp.ones(512) @ x)(rows),
}.items():
    print(f"{name}|{hashlib.sha256(np.asarray(found).tobytes()).hexdigest()}")
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
name = "sum of 512 x 128"
same[f"{name} without threads of Eigen"] = found(1, **flag)[name] == found(2, **flag)[name]
for name, equal in same.items():
    print(f"{name}: {'the same' if equal else 'differs'} on 1 and 2 cores")
assert list(same.values()) == [True, False, True, False, True, False], "a release has changed"
PY
"$work/venv/bin/python" "$work/compare.py" "$work/sums.py"
echo "as described"
