#!/usr/bin/env bash
# Brax: the learners of its newest release do not run with the newest JAX that its requirements admit.
#
# Versions: brax 0.14.2 with jax and jaxlib 0.10.2 (CPU). Behaviour: pip installs the two together and `pip check` is
# content, for brax asks for jax>=0.4.6 without an upper bound. Environments and wrappers work. PPO and SAC (and APG, which
# calls the same function) end before their first step: they copy their state to the devices with
# jax.device_put_replicated, which jax has dropped, with the advice to use jax.device_put and a page on the migration.
# It matters to whoever wants Brax's own learners as a baseline: pin jax below 0.10, or give jax a function of that name
# before training.
# Output seen:
#   environment: ok
#   ppo: AttributeError, jax.device_put_replicated is deprecated; use jax.device_put instead.
#   sac: AttributeError, jax.device_put_replicated is deprecated; use jax.device_put instead.
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet "brax==0.14.2" "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.6"
"$work/venv/bin/pip" check
"$work/venv/bin/python" - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import jax
from brax.envs import get_environment
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import train as sac

env = get_environment("fast")
state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.numpy.zeros(env.action_size))
print("environment: ok", flush=True)
few = {"num_timesteps": 128, "episode_length": 64, "num_envs": 8, "num_evals": 1}
for name, train, more in (
    ("ppo", ppo.train, {"unroll_length": 4, "batch_size": 8, "num_minibatches": 1}),
    ("sac", sac.train, {"min_replay_size": 16, "batch_size": 8}),
):
    try:
        train(env, **few, **more)
    except AttributeError as error:
        print(f"{name}: AttributeError, {str(error).split(' See')[0]}", flush=True)
        assert "device_put_replicated" in str(error)
    else:
        raise SystemExit(f"{name} trains: the release has changed")
PY
echo "as described"
