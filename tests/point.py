"""A point in the plane as task and data: everything about it is known, and it costs nothing to simulate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct

from qdos_brax import config as configs
from qdos_brax.data.dataset import Dataset
from qdos_brax.population.members import Population

STEP = 0.1
GOAL = np.array([1.0, 0.0], np.float32)
TOLERANCE = 0.25


class Point(struct.PyTreeNode):
    """The simulator's state."""

    qpos: jax.Array
    qvel: jax.Array


class PointEnv(Env):
    """x' = x + 0.1 a in the plane; success (read before the action) within 0.25 of (1, 0); starts near the origin."""

    goal_xy = GOAL
    observation_size = 2
    action_size = 2
    episode_length = 60
    backend = "toy"
    extra_size = 0
    body_frame = None

    def reset(self, rng):
        return self.reset_to(0.1 * jax.random.normal(rng, (2,)), jnp.zeros(2), GOAL, rng)

    def reset_to(self, qpos, qvel, goal=None, key=None, extra=None):
        obs = qpos
        info = {
            "truncation": jnp.zeros(()),
            "final_obs": obs,
            "steps": jnp.zeros((), jnp.int32),
            "reset_key": jax.random.key(0) if key is None else key,
        }
        return State(Point(qpos, qvel), obs, jnp.zeros(()), jnp.zeros(()), {"success": jnp.zeros(())}, info)

    def step(self, state, action):
        success = (jnp.linalg.norm(state.pipeline_state.qpos - GOAL) <= TOLERANCE).astype(jnp.float32)
        qpos = state.pipeline_state.qpos + STEP * jnp.clip(action, -1, 1)
        obs = qpos
        steps = state.info["steps"] + 1
        capped = (steps >= self.episode_length).astype(jnp.float32)
        return state.replace(
            pipeline_state=Point(qpos, action),
            obs=obs,
            reward=success - 1,
            done=jnp.maximum(success, capped),
            metrics={"success": success},
            info=state.info | {"steps": steps, "truncation": capped * (1 - success), "final_obs": obs},
        )


def point_dataset(
    episodes: int = 200, length: int = 30, seed: int = 0, spread: float = np.pi, speed: float = 0.9
) -> Dataset:
    """Straight walks in directions within ``spread`` of +x that change every 15 steps, from random starts."""
    rng = np.random.default_rng(seed)
    angles = np.repeat(rng.uniform(-spread, spread, (episodes, length // 15)), 15, axis=1)
    actions = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * speed + 0.05 * rng.normal(
        size=(episodes, length, 2)
    )
    actions = np.clip(actions, -1, 1).astype(np.float32)
    start = rng.uniform(-1.0, 1.0, (episodes, 1, 2))
    positions = np.concatenate([start, start + STEP * np.cumsum(actions, axis=1)], axis=1).astype(np.float32)
    previous = np.concatenate([np.zeros((episodes, 1, 2), np.float32), actions], axis=1)
    success = np.linalg.norm(positions[:, :-1] - GOAL, axis=-1) <= TOLERANCE
    ends = np.zeros((episodes, length), bool)
    ends[:, -1] = True
    flat = lambda x: np.ascontiguousarray(x.reshape(episodes * length, *x.shape[2:]), np.float32)  # noqa: E731
    return Dataset(
        observations=flat(positions[:, :-1]),
        actions=flat(actions),
        rewards=flat(success - 1.0),
        masks=flat(1.0 - success),
        ends=ends.reshape(-1),
        next_observations=flat(positions[:, 1:]),
        qpos=flat(positions[:, :-1]),
        qvel=flat(previous[:, :-1]),
        source="the plane",
    )


def point_config(**values) -> configs.Config:
    """The smoke preset, shrunk to the plane; dotted keys as keyword entries of a dict."""
    small = {
        "skills.horizon": 5,
        "values.n_step": 5,
        "skills.latent_dim": 2,
        "skills.mi_rollout": "physics",
        "high_level.num_envs": 2,
        "high_level.env_steps": 200,
        "high_level.warmup_env_steps": 20,
        "labels.start_env_steps": 20,
        "eval.episodes": 2,
        "eval.every_env_steps": 100,
    }
    return configs.load_config("antmaze-medium", "smoke", small | values)


def bound(phase, config, data):
    """``phase`` with its programs compiled for the members of ``config`` on ``data``."""
    phase.bind(Population(configs.population_hyper(config)), data)
    return phase


def run_phase(phase, keys, artifacts):
    """(state, metrics of every chunk, artifacts) of a whole phase."""
    (state, constants), history = phase.init(keys, artifacts), []
    for _ in range(phase.num_chunks):
        state, metrics = phase.chunk(state, constants)
        history.append(metrics)
    return state, history, phase.finish(state, artifacts)


def first_member(tree):
    """One member's part of a tree with a leading member axis."""
    return jax.tree.map(lambda x: x[0], tree)
