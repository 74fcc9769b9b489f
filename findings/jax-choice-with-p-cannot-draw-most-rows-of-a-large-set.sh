#!/usr/bin/env bash
# jax: choice(key, n, p=weights) cannot draw most of the rows of a large set, whatever their weights are.
#
# Versions: jax and jaxlib 0.10.2 (CPU). Behaviour: with p, a row is found by one float32 number of 23 random bits in
# the running sum of p. There are 2^23 = 8,388,608 such numbers, so that no more rows than that can ever be drawn: of
# 20 million rows with equal weights 58 % never are, in however many draws. Nothing says so; without p, rows are drawn
# as whole numbers, and all of them can be. Who draws a replay's rows by weight or priority out of many millions
# trains on a part of them.
# What helps: rows drawn uniformly and the weight in the loss; a block of rows by weight first and then a row in it;
# float64 (jax_enable_x64 and a p of that type), which draws by 52 bits.
# Output seen:
#   20,000,000 rows, 100,000,000 draws: without p 0.99 of the rows drawn, with equal p 0.42, with p in float64 0.99
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY' | tee "$work/seen.txt"
import jax
import jax.numpy as jnp
import numpy as np

ROWS, DRAWS, ROUNDS = 20_000_000, 20_000_000, 5


def share_drawn(dtype):
    p = None if dtype is None else jnp.full(ROWS, 1 / ROWS, dtype)
    drawn = np.zeros(ROWS, bool)
    for key in jax.random.split(jax.random.key(0), ROUNDS):
        drawn[np.asarray(jax.random.choice(key, ROWS, (DRAWS,), p=p))] = True
    return drawn.mean()


without, single = share_drawn(None), share_drawn(jnp.float32)
with jax.enable_x64(True):
    double = share_drawn(jnp.float64)
print(
    f"{ROWS:,} rows, {ROUNDS * DRAWS:,} draws: without p {without:.2f} of the rows drawn, "
    f"with equal p {single:.2f}, with p in float64 {double:.2f}"
)
PY
diff "$work/seen.txt" - <<'SEEN'
20,000,000 rows, 100,000,000 draws: without p 0.99 of the rows drawn, with equal p 0.42, with p in float64 0.99
SEEN
echo "as described"
