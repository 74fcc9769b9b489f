#!/usr/bin/env bash
# jax 0.10.2 on a CPU: the gradient of a vmapped ensemble of critics is no faster on two cores than on one; of the same
# critics one by one it is.
#
# Versions: jax 0.10.2, jaxlib 0.10.2, numpy 2.4.6. Behaviour: four networks of 37-128-128-128-1 with layer norm, a
# batch of 128, gradient steps in a scan, as critic ensembles are written (flax's nn.vmap, jax.vmap): one batched matmul
# per layer. A second core makes that step slower, not faster. Of the same networks written as a loop over four trees of
# parameters it makes it faster, and on one core the two ways take the same time. It was so with
# --xla_cpu_multi_thread_eigen=false and with the concurrency-optimised scheduler, too. It matters to whoever learns
# with small critic ensembles on a laptop. In a whole training step, which samples and acts as well, less is left of
# it; stacking the four trees again in each step loses it.
# Output seen (times vary):
#   vmapped: 3.18 ms on one core, 3.78 on two, 0.84 times as fast
#   one by one: 3.16 ms on one core, 2.53 on two, 1.25 times as fast
set -euo pipefail
unset PYTHONPATH XLA_FLAGS
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
cat > "$work/step.py" <<'PY'
import os
import sys
import time

os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])])
import jax  # after the affinity, from which it takes its threads
import jax.numpy as jnp

SIZES, HEADS, BATCH, STEPS = (37, 128, 128, 128, 1), 4, 128, 200


def network(params, x):
    for weight, shift in params[:-1]:
        x = x @ weight + shift
        x = jax.nn.relu((x - x.mean(-1, keepdims=True)) * jax.lax.rsqrt(x.var(-1, keepdims=True) + 1e-6))
    return (x @ params[-1][0] + params[-1][1])[..., 0]


def fresh(key):
    pairs = list(zip(SIZES[:-1], SIZES[1:]))
    return [
        (jax.random.normal(own, pair) * pair[0] ** -0.5, jnp.zeros(pair[1]))
        for own, pair in zip(jax.random.split(key, len(pairs)), pairs)
    ]


x = jax.random.normal(jax.random.key(1), (BATCH, SIZES[0]))
y = jax.random.normal(jax.random.key(2), (BATCH,))
apart = [fresh(jax.random.key(head)) for head in range(HEADS)]
stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *apart)


def vmapped(params):
    return jnp.sum(jnp.mean((jax.vmap(network, (0, None))(params, x) - y) ** 2, axis=-1))


def one_by_one(params):
    return sum(jnp.mean((network(own, x) - y) ** 2) for own in params)


for loss, params in ((vmapped, stacked), (one_by_one, apart)):
    step = lambda params, _: (jax.tree.map(lambda p, g: p - 1e-3 * g, params, jax.grad(loss)(params)), None)
    run = jax.jit(lambda params: jax.lax.scan(step, params, None, length=STEPS)[0])
    params, times = jax.block_until_ready(run(params)), []
    for _ in range(15):
        began = time.perf_counter()
        params = jax.block_until_ready(run(params))
        times.append((time.perf_counter() - began) / STEPS * 1e3)
    print(min(times))
PY
"$work/venv/bin/python" - "$work/step.py" <<'PY'
import os
import subprocess
import sys

if len(os.sched_getaffinity(0)) < 2:
    raise SystemExit("this needs two cores")
times = {
    cores: [
        float(line)
        for line in subprocess.run(
            [sys.executable, sys.argv[1], str(cores)], check=True, capture_output=True, text=True
        ).stdout.split()
    ]
    for cores in (1, 2)
}
for name, one, two in zip(("vmapped", "one by one"), times[1], times[2]):
    print(f"{name}: {one:.2f} ms on one core, {two:.2f} on two, {one / two:.2f} times as fast")
assert times[1][0] / times[2][0] < 1.05, "a second core now helps a vmapped ensemble"
assert times[1][1] / times[2][1] > 1.05, "a second core no longer helps networks one by one"
PY
