"""Trains the direction-conditioned ant with SAC on MuJoCo C: ``python -m qdos_brax.experts.train_walker --out FILE``.

Reward: displacement of the torso along the commanded direction (OGBench's recipe), which is redrawn now and then; an
episode ends when the ant falls. One jitted program steps all environments, fills the replay and makes the updates.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from envs.models import ant_model
from envs.physics.base import PipelineState
from envs.physics.mujoco_engine import MujocoEngine
from qdos_brax.experts import walker
from qdos_brax.high_level import replay as replay_buffer
from qdos_brax.high_level.sac import SAC, Batch, SACHyper, SACState

REWARD_SCALE = 10.0
TURN_EVERY = 100


class Sizes(NamedTuple):
    """Static sizes of the training."""

    num_envs: int = 64
    updates_per_step: int = 32
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    capacity: int = 500_000
    random_steps: int = 5_000
    steps_per_chunk: int = 50


class Walk(NamedTuple):
    """What one control step of N ants brought.

    Attributes:
        after: the states it led to.
        onward: the same, with every fallen ant stood up.
        direction: float[N, 2], the directions commanded from here on.
        speed: float[N], metres gained along the direction that was commanded.
        alive: bool[N], False where the ant fell.
    """

    after: PipelineState
    onward: PipelineState
    direction: jax.Array
    speed: jax.Array
    alive: jax.Array


class TrainState(struct.PyTreeNode):
    """Everything the loop carries."""

    sac: SACState
    replay: replay_buffer.Replay
    pipeline: PipelineState
    direction: jax.Array
    key: jax.Array


def random_direction(key: jax.Array) -> jax.Array:
    """A unit vector[2], uniform over the circle."""
    angle = jax.random.uniform(key, (), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


class Trainer:
    """The program: ``init`` and ``chunk``."""

    def __init__(self, engine: MujocoEngine, sizes: Sizes) -> None:
        self.engine, self.sizes = engine, sizes
        self.sac = SAC(walker.OBSERVATION_DIM, walker.ACTION_DIM, sizes.hidden, 2, 2, entropy_backup=True)
        self.hyper = SACHyper(
            learning_rate=3e-4, discount=0.99, target_rate=0.005, target_entropy=-walker.ACTION_DIM / 2
        )
        self.rest = jnp.asarray(engine.model.qpos0, jnp.float32)

    def reset(self, key: jax.Array) -> PipelineState:
        """A standing ant with OGBench's reset noise."""
        qpos_key, qvel_key = jax.random.split(key)
        qpos = self.rest + jax.random.uniform(qpos_key, self.rest.shape, minval=-0.1, maxval=0.1)
        return self.engine.init(qpos, 0.1 * jax.random.normal(qvel_key, (self.engine.nv,)))

    def init(self, key: jax.Array) -> TrainState:
        """Fresh networks, an empty replay, environments at rest."""
        sac_key, reset_key, direction_key, key = jax.random.split(key, 4)
        n = self.sizes.num_envs
        observation = jnp.zeros(walker.OBSERVATION_DIM)
        row = Batch(observation, jnp.zeros(walker.ACTION_DIM), jnp.zeros(()), jnp.zeros(()), observation)
        return TrainState(
            sac=self.sac.init(sac_key, 1.0),
            replay=replay_buffer.create(row, self.sizes.capacity),
            pipeline=jax.vmap(self.reset)(jax.random.split(reset_key, n)),
            direction=jax.vmap(random_direction)(jax.random.split(direction_key, n)),
            key=key,
        )

    @partial(jax.jit, static_argnums=(0, 2), donate_argnums=1)
    def chunk(self, state: TrainState, random_actions: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        """``steps_per_chunk`` steps of every environment; with updates unless the actions are random."""

        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            state, info = self._environment_step(state, random_actions)
            if random_actions:
                return state, info
            keys = jax.random.split(state.key, self.sizes.updates_per_step + 1)
            sac, losses = jax.lax.scan(partial(self._update, state.replay), state.sac, keys[1:])
            return state.replace(sac=sac, key=keys[0]), {**info, **jax.tree.map(jnp.mean, losses)}

        state, info = jax.lax.scan(step, state, length=self.sizes.steps_per_chunk)
        return state, jax.tree.map(jnp.mean, info)

    def _environment_step(self, state: TrainState, random_actions: bool) -> tuple[TrainState, dict[str, jax.Array]]:
        n = self.sizes.num_envs
        act_key, walk_key, key = jax.random.split(state.key, 3)
        observe = jax.vmap(walker.canonical_observation)
        before = state.pipeline
        observation = observe(before.qpos, before.qvel, state.direction)
        if random_actions:
            action = jax.random.uniform(act_key, (n, walker.ACTION_DIM), minval=-1.0)
        else:
            action = self.sac.act(state.sac.actor, act_key, observation)
        walk = self.walk(before, action, state.direction, walk_key)
        row = Batch(
            observation,
            action,
            REWARD_SCALE * walk.speed,
            walk.alive.astype(jnp.float32),
            observe(walk.after.qpos, walk.after.qvel, state.direction),
        )
        state = state.replace(
            replay=replay_buffer.insert(state.replay, row), pipeline=walk.onward, direction=walk.direction, key=key
        )
        return state, {"speed": jnp.mean(walk.speed), "falls_per_1000": 1000 * jnp.mean(1.0 - walk.alive)}

    def walk(self, before: PipelineState, action: jax.Array, direction: jax.Array, key: jax.Array) -> Walk:
        """One control step of N ants; the fallen are stood up, and now and then a direction is redrawn.

        Args:
            before: states [N].
            action: float[N, 8].
            direction: float[N, 2], unit vectors.
            key: a fresh key.
        """
        n = direction.shape[0]
        reset_key, turn_key, turn_to_key = jax.random.split(key, 3)
        after = jax.vmap(self.engine.step)(before, action)
        speed = jnp.sum((after.qpos[:, :2] - before.qpos[:, :2]) * direction, axis=-1)
        alive = walker.upright(after.qpos)
        fresh = jax.vmap(self.reset)(jax.random.split(reset_key, n))
        onward = jax.tree.map(lambda a, b: jnp.where(alive.reshape(n, *[1] * (a.ndim - 1)), a, b), after, fresh)
        turned = jax.vmap(random_direction)(jax.random.split(turn_to_key, n))
        turns = jax.random.uniform(turn_key, (n, 1)) < 1 / TURN_EVERY
        return Walk(after, onward, jnp.where(turns, turned, direction), speed, alive)

    def _update(
        self, replay: replay_buffer.Replay, sac: SACState, key: jax.Array
    ) -> tuple[SACState, dict[str, jax.Array]]:
        sample_key, critic_key, actor_key = jax.random.split(key, 3)
        batch = replay_buffer.sample(replay, sample_key, self.sizes.batch_size)
        sac, critic_info = self.sac.update_critic(sac, batch, critic_key, self.hyper)
        sac, actor_info = self.sac.update_actor(sac, batch.observation, actor_key, self.hyper)
        return sac, {**critic_info, **actor_info}


def evaluate(engine: MujocoEngine, policy: walker.WalkerPolicy, key: jax.Array, num_envs: int = 64) -> dict[str, float]:
    """Walks 1,000 steps per environment with the deterministic policy, the direction redrawn every 100 steps.

    Returns:
        ``speed``: mean displacement along the commanded direction, m per control step of 0.1 s, and
        ``falls_per_1000``: falls per 1,000 control steps (a fallen ant is stood up again).
    """
    trainer = Trainer(engine, Sizes(num_envs=num_envs))

    def step(carry: tuple[PipelineState, jax.Array], key: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        pipeline, direction = carry
        walk = trainer.walk(pipeline, policy.act(pipeline.qpos, pipeline.qvel, direction), direction, key)
        return (walk.onward, walk.direction), (jnp.mean(walk.speed), jnp.mean(1.0 - walk.alive))

    reset_key, direction_key, key = jax.random.split(key, 3)
    start = jax.vmap(trainer.reset)(jax.random.split(reset_key, num_envs))
    direction = jax.vmap(random_direction)(jax.random.split(direction_key, num_envs))
    _, (speed, falls) = jax.jit(lambda c, k: jax.lax.scan(step, c, k))((start, direction), jax.random.split(key, 1000))
    return {"speed": float(speed.mean()), "falls_per_1000": 1000 * float(falls.mean())}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="file for the weights (.npz), rewritten as it improves")
    parser.add_argument("--steps", type=int, default=160_000, help="environment steps (default 160000)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)

    sizes = Sizes()
    engine = MujocoEngine(ant_model())
    trainer = Trainer(engine, sizes)
    train_key, evaluate_key = jax.random.split(jax.random.key(args.seed))
    state = trainer.init(train_key)
    per_chunk = sizes.num_envs * sizes.steps_per_chunk
    start = time.time()
    steps = 0
    while steps < args.steps:
        state, info = trainer.chunk(state, steps < sizes.random_steps)
        steps += per_chunk
        row = " ".join(f"{name}={float(value):.4g}" for name, value in sorted(info.items()))
        print(f"steps={steps} seconds={time.time() - start:.0f} {row}", flush=True)
        if (steps // per_chunk) % 10 == 0 or steps >= args.steps:
            policy = walker.WalkerPolicy(sizes.hidden, state.sac.actor)
            reached = evaluate(engine, policy, evaluate_key)
            facts = {"steps": steps, "seed": args.seed, "seconds": round(time.time() - start), **reached}
            walker.save(args.out, sizes.hidden, state.sac.actor, facts)
            print(f"evaluation {facts}", flush=True)


if __name__ == "__main__":
    main()
