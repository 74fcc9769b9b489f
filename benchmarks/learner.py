"""How fast the learners are: ``python benchmarks/learner.py [--out results/learner.json]``.

SAC at the paper's sizes (ten critics of 3 x 256 with LayerNorm, batch 256, 20 critic updates per actor update, on rows
as wide as an ant maze's with a latent of 8): critic updates per second of

    bare        the matmuls of one critic update alone, forward and backward, each layer one batched matmul
    reference   as published learners do it (compare github.com/ikostrikov/rlpd): flax's ``nn.vmap`` ensemble, optax's
                Adam, the critic updates in one scan, their batches gathered by NumPy and handed over from the host
    ours        ``qdos_brax.high_level.sac`` with batches drawn on the device

and the trajectory VAE's pretraining step (two bidirectional layers of 256, H = 20, batch 256): steps per second of
flax's ``nn.RNN(nn.GRUCell)`` and of ours. Each round measures all of them one after another; the ratios are medians
over the rounds, so that a machine whose speed drifts does not favour one.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from learner_vae import BATCH, LATENT, OBSERVATION, RATE, Calls, our_vae, reference_vae

from qdos_brax.config import HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.files import write_text
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.sac import SAC, SACHyper
from qdos_brax.nn.networks import (
    DiagonalGaussian,
    tanh_gaussian_sample,
)

CRITICS, UTD, ROWS = 10, 20, 50_000
DISCOUNT, TARGET_RATE = 0.99, 0.005


# --- SAC ---------------------------------------------------------------------------------------------------------


def transitions() -> Transition:
    """Made-up rows, NumPy."""
    random = np.random.default_rng(0)
    normal = lambda *shape: random.standard_normal(shape).astype(np.float32)  # noqa: E731
    action = np.tanh(normal(ROWS, LATENT))
    return Transition(
        normal(ROWS, OBSERVATION),
        action,
        -np.ones(ROWS, np.float32),
        np.ones(ROWS, np.float32),
        normal(ROWS, OBSERVATION),
    )


def layers(width: int) -> list[tuple[int, int]]:
    """(in, out) of a critic's matmuls but the last, whose output is a number."""
    return [(OBSERVATION + LATENT, width), (width, width), (width, width)]


def critic_flops(width: int) -> int:
    """Of the matmuls in ``bare``: forward, gradient of the weights, and of the inputs but the first layer's."""
    forward = [2 * CRITICS * BATCH * a * b for a, b in layers(width)]
    return 3 * sum(forward) - forward[0]


def sac_flops(width: int) -> int:
    """Of the large matmuls of one of our critic updates.

    Those of ``bare``, one target head, the actor's action, and a UTD-th of the actor's update (its own, forward and
    backward, and the critics' forward and gradient of the inputs).
    """
    head = sum(2 * BATCH * a * b for a, b in layers(width))
    actor = sum(2 * BATCH * a * b for a, b in [(OBSERVATION, width), *layers(width)[1:]])
    return critic_flops(width) + head + actor + (3 * actor + 2 * CRITICS * head) // UTD


def bare_matmuls(width: int) -> Calls:
    """One critic update's batched matmuls, nothing else.

    Every round depends on the one before through a zero that the compiler cannot see, so that none leaves the loop.
    """
    keys = iter(jax.random.split(jax.random.key(0), 4))
    weights = [jax.random.normal(next(keys), (CRITICS, a, b)) / a**0.5 for a, b in layers(width)]
    observed = jax.random.normal(next(keys), (CRITICS, BATCH, layers(width)[0][0]))

    def update(zero: jax.Array, _: None) -> tuple[jax.Array, None]:
        inputs, x = [], observed + zero
        for weight in weights:
            inputs.append(x)
            x = x @ weight
        gradients = []
        for layer in reversed(range(len(weights))):
            gradients.append(jnp.einsum("ebi,ebo->eio", inputs[layer], x))
            x = jnp.einsum("ebo,eio->ebi", x, weights[layer]) if layer else x
        return 0.0 * sum(g[0, 0, 0] for g in jax.lax.optimization_barrier(gradients)), None

    run = jax.jit(lambda zero: jax.lax.scan(update, zero, length=UTD)[0])

    def calls() -> int:
        run(jnp.zeros(())).block_until_ready()
        return UTD

    return calls


class Critic(nn.Module):
    """The published critic: Dense, LayerNorm, ReLU."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        """[..., obs], [..., act] -> [...]."""
        x = jnp.concatenate([observation, action], axis=-1)
        for width in self.hidden:
            x = nn.relu(nn.LayerNorm()(nn.Dense(width)(x)))
        return nn.Dense(1)(x)[..., 0]


def reference_sac(width: int) -> Calls:
    """See the module."""

    def ensemble(size: int) -> Any:
        heads = nn.vmap(Critic, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None, axis_size=size)
        return heads((width,) * 3)

    critic, drawn, actor = ensemble(CRITICS), ensemble(1), DiagonalGaussian((width,) * 3, LATENT)
    optimiser = optax.adam(RATE)
    observation, action = jnp.zeros((1, OBSERVATION)), jnp.zeros((1, LATENT))
    parameters = {
        "critic": critic.init(jax.random.key(0), observation, action),
        "actor": actor.init(jax.random.key(1), observation),
    }
    parameters["target"] = jax.tree.map(jnp.copy, parameters["critic"])
    parameters["log_temperature"] = jnp.zeros(())
    opt_state = {name: optimiser.init(parameters[name]) for name in ("critic", "actor", "log_temperature")}

    def stepped(parameters: Any, opt_state: Any, name: str, gradient: Any) -> tuple[Any, Any]:
        updates, new = optimiser.update(gradient, opt_state[name])
        return parameters | {name: optax.apply_updates(parameters[name], updates)}, opt_state | {name: new}

    def critic_step(carry: Any, given: tuple[Transition, jax.Array]) -> tuple[Any, jax.Array]:
        (parameters, opt_state), (batch, key) = carry, given
        action_key, subset_key = jax.random.split(key)
        action, _ = tanh_gaussian_sample(action_key, *actor.apply(parameters["actor"], batch.next_observation))
        index = jax.random.choice(subset_key, CRITICS, (1,), replace=False)
        chosen = jax.tree.map(lambda p: p[index], parameters["target"])  # RLPD's ``subsample_ensemble``
        value = drawn.apply(chosen, batch.next_observation, action).min(axis=0)
        target = batch.reward + DISCOUNT * batch.mask * value

        def loss(critic_parameters: Any) -> jax.Array:
            return jnp.mean((critic.apply(critic_parameters, batch.observation, batch.action) - target) ** 2)

        found, gradient = jax.value_and_grad(loss)(parameters["critic"])
        parameters, opt_state = stepped(parameters, opt_state, "critic", gradient)
        target = optax.incremental_update(parameters["critic"], parameters["target"], TARGET_RATE)
        return (parameters | {"target": target}, opt_state), found

    @jax.jit
    def update(parameters: Any, opt_state: Any, batches: Transition, key: jax.Array) -> tuple[Any, Any]:
        critic_key, actor_key = jax.random.split(key)
        keys = jax.random.split(critic_key, UTD)
        (parameters, opt_state), _ = jax.lax.scan(critic_step, (parameters, opt_state), (batches, keys))
        seen, temperature = batches.observation[-1], jnp.exp(parameters["log_temperature"])

        def actor_loss(actor_parameters: Any) -> tuple[jax.Array, jax.Array]:
            action, log_prob = tanh_gaussian_sample(actor_key, *actor.apply(actor_parameters, seen))
            value = critic.apply(parameters["critic"], seen, action).mean(axis=0)
            return jnp.mean(temperature * log_prob - value), -jnp.mean(log_prob)

        (_, entropy), gradient = jax.value_and_grad(actor_loss, has_aux=True)(parameters["actor"])
        parameters, opt_state = stepped(parameters, opt_state, "actor", gradient)
        gradient = jax.grad(lambda log: jnp.exp(log) * (entropy + LATENT / 2))(parameters["log_temperature"])
        return stepped(parameters, opt_state, "log_temperature", gradient)

    rows, random, held = transitions(), np.random.default_rng(1), [parameters, opt_state, 0]

    def calls() -> int:
        index = random.integers(0, ROWS, (UTD, BATCH))
        held[2] += 1
        batches = Transition(*(field[index] for field in rows))
        held[:2] = jax.block_until_ready(update(held[0], held[1], batches, jax.random.key(held[2])))
        return UTD

    return calls


def our_sac(width: int) -> Calls:
    """As ``OnlinePhase`` makes them, without what labels and acts."""
    sac = SAC(OBSERVATION, LATENT, HighLevelConfig(hidden=(width,) * 3, ensemble=CRITICS, target_subset=1))
    hyper = SACHyper(RATE, DISCOUNT, TARGET_RATE, -LATENT / 2)
    rows = jax.tree.map(jnp.asarray, transitions())
    replay = replay_buffer.Replay(rows, jnp.zeros((), jnp.int32), jnp.full((), ROWS, jnp.int32))

    def critic_step(state: Any, key: jax.Array) -> tuple[Any, Any]:
        batch_key, update_key = jax.random.split(key)
        return sac.update_critic(state, replay_buffer.sample(replay, batch_key, BATCH), update_key, hyper)

    def update(state: Any, key: jax.Array) -> Any:
        critic_key, batch_key, actor_key = jax.random.split(key, 3)
        state, _ = jax.lax.scan(critic_step, state, jax.random.split(critic_key, UTD))
        batch = replay_buffer.sample(replay, batch_key, BATCH)
        return sac.update_actor(state, batch, actor_key, hyper)[0]

    run = jax.jit(update, donate_argnums=0)
    held = [sac.init(jax.random.key(0), 1.0), 0]

    def calls() -> int:
        held[1] += 1
        held[0] = jax.block_until_ready(run(held[0], jax.random.key(held[1])))
        return UTD

    return calls


# --- Measuring ---------------------------------------------------------------------------------------------------


def rate(calls: Calls, seconds: float) -> float:
    """Updates per second over about so many seconds."""
    made, began = 0, time.perf_counter()
    while made == 0 or time.perf_counter() - began < seconds:
        made += calls()
    return made / (time.perf_counter() - began)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=256, help="of the critics' three hidden layers (default 256)")
    parser.add_argument("--rounds", type=int, default=5, help="default 5")
    parser.add_argument("--seconds", type=float, default=4.0, help="per measurement (default 4)")
    parser.add_argument("--out", type=Path, help="JSON file")
    args = parser.parse_args()

    makers = {
        "bare": lambda: bare_matmuls(args.width),
        "reference": lambda: reference_sac(args.width),
        "ours": lambda: our_sac(args.width),
        "vae_reference": reference_vae,
        "vae_ours": our_vae,
    }
    cells = {name: make() for name, make in makers.items()}
    for calls in cells.values():
        calls()  # compiles
    rounds = [{name: rate(calls, args.seconds) for name, calls in cells.items()} for _ in range(args.rounds)]
    median = {name: statistics.median(row[name] for row in rounds) for name in cells}
    ratio = lambda a, b: round(statistics.median(row[a] / row[b] for row in rounds), 3)  # noqa: E731
    found = {
        "width": args.width,
        "updates_per_second": {name: round(value, 2) for name, value in median.items()},
        "gflops": {
            "bare": round(median["bare"] * critic_flops(args.width) / 1e9, 1),
            "ours": round(median["ours"] * sac_flops(args.width) / 1e9, 1),
        },
        "ours / reference": ratio("ours", "reference"),
        "ours / bare (flop/s)": round(ratio("ours", "bare") * sac_flops(args.width) / critic_flops(args.width), 3),
        "vae_ours / vae_reference": ratio("vae_ours", "vae_reference"),
        "machine": {"processor": platform.processor() or platform.machine(), "jax": jax.__version__},
    }
    print(json.dumps(found, indent=1))
    if args.out:
        write_text(args.out, json.dumps(found | {"rounds": rounds}, indent=1) + "\n")


if __name__ == "__main__":
    main()
