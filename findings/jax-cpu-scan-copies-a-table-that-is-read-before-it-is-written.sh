#!/usr/bin/env bash
# jax 0.10.2 on a CPU: a scan that reads a row of a large table, changes that row and gives out what it read copies the
# whole table at every step; the same numbers from a read after the write copy nothing.
#
# Versions: jax 0.10.2, jaxlib 0.10.2, numpy 2.4.6. Behaviour: visit counts of a million states are carried through
# lax.scan, the argument is donated. "bonus = counts[s]; counts = counts.at[s].add(1)" takes a time that grows with the
# number of states; "counts = counts.at[s].add(1); bonus = counts[s] - 1" does not, and gives the same numbers. It is
# the reading of the old row for the scan's output that counts: with mode="drop", with an optimization_barrier between
# read and write, and for a gather of many rows it was the same, and without the output nothing is copied. (A barrier
# does help with jax 0.12.0.1, which is otherwise alike; jax issue 17845 has a relative of 2023.) It matters to whoever
# keeps counts, traces, priorities or an evicting replay buffer inside a jitted training loop: nothing but the time
# shows it.
# Output seen (times vary):
#   read first:   10,000 states 2.37 us a step, 1,000,000 states 1011.13 us
#   write first:  10,000 states 0.03 us a step, 1,000,000 states 0.02 us
#   equal numbers: True
set -euo pipefail
unset PYTHONPATH XLA_FLAGS
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY'
import time

import jax
import jax.numpy as jnp
import numpy as np

STEPS, SIZES = 1000, (10_000, 1_000_000)


def read_first(counts, s):
    bonus = counts[s]
    return counts.at[s].add(1.0), bonus


def write_first(counts, s):
    counts = counts.at[s].add(1.0)
    return counts, counts[s] - 1.0


def measure(step, states):
    run = jax.jit(lambda counts: jax.lax.scan(step, counts, jnp.arange(STEPS) * 7 % 97), donate_argnums=0)
    counts, first = jax.block_until_ready(run(jnp.zeros(states)))
    times = []
    for _ in range(5):
        began = time.perf_counter()
        counts, _ = jax.block_until_ready(run(counts))
        times.append((time.perf_counter() - began) / STEPS * 1e6)
    return min(times), np.asarray(first)


found = {step.__name__: [measure(step, states) for states in SIZES] for step in (read_first, write_first)}
for name, ((small, _), (large, _)) in found.items():
    label = name.replace("_", " ") + ":"
    print(f"{label:13s} {SIZES[0]:,} states {small:.2f} us a step, {SIZES[1]:,} states {large:.2f} us")
same = all(np.array_equal(a, b) for (_, a), (_, b) in zip(found["read_first"], found["write_first"]))
print("equal numbers:", same)
assert same
assert found["read_first"][1][0] > 20 * found["write_first"][1][0], "reading first no longer copies the table"
assert found["write_first"][1][0] < 20 * found["write_first"][0][0], "writing first copies the table now"
PY
