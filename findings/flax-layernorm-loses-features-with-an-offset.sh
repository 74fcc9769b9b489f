#!/usr/bin/env bash
# Flax: LayerNorm's default variance is wrong by orders of magnitude where features share an offset.
#
# Versions: flax 0.12.8, jax 0.10.2 (CPU, float32). Behaviour: nn.LayerNorm() computes the variance as E[x^2] - E[x]^2 in
# one pass (use_fast_variance=True, the default). Features of standard deviation 1 around an offset of 1,000 are
# off by 0.3 of a standard deviation, around 10,000 by thousands: the difference of two nearly equal numbers rounds to zero
# or below, is clipped at 0, and the output is divided by sqrt(epsilon). use_fast_variance=False stays below 0.002.
# It matters wherever raw positions or raw observations reach a normalised layer (RND, critics of RLPD's kind).
# Output seen (largest error against float64; standard deviations):
#   offset 0: default below 1e-5, two passes below 1e-5
#   offset 1000: default above 0.1, two passes below 1e-3
#   offset 10000: default above 100, two passes below 1e-2
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "flax==0.12.8" "jax==0.10.2" "numpy==2.4.6"
"$work/venv/bin/python" - <<'PY'
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

noise = np.random.default_rng(0).normal(size=(4, 64)).astype(np.float32)


def error(offset, fast):
    x = jnp.asarray(noise + np.float32(offset))
    exact = np.asarray(x, np.float64)
    exact = (exact - exact.mean(-1, keepdims=True)) / np.sqrt(exact.var(-1, keepdims=True) + 1e-6)
    layer = nn.LayerNorm(use_fast_variance=fast)
    return float(np.abs(np.asarray(layer.apply(layer.init(jax.random.key(0), x), x)) - exact).max())


for offset, low, high, two in ((0, 0, 1e-5, 1e-5), (1000, 0.1, np.inf, 1e-3), (10000, 100, np.inf, 1e-2)):
    default, exact = error(offset, True), error(offset, False)
    print(f"offset {offset}: default {default:.3g}, two passes {exact:.3g}")
    assert low <= default <= high and exact <= two
PY
echo "as described"
