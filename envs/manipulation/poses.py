"""Compute with unit quaternions (w, x, y, z), in stacked NumPy, in the order of operations of OGBench's ``lie``."""

from __future__ import annotations

import mujoco
import numpy as np

DOWN = np.array([0.0, 1.0, 0.0, 0.0])
"""How the hand is turned where it points down, with yaw 0."""


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products ``a b`` of quaternions [..., 4]."""
    w0, x0, y0, z0 = np.moveaxis(a, -1, 0)
    w1, x1, y1, z1 = np.moveaxis(b, -1, 0)
    product = [
        -x0 * x1 - y0 * y1 - z0 * z1 + w0 * w1,
        x0 * w1 + y0 * z1 - z0 * y1 + w0 * x1,
        -x0 * z1 + y0 * w1 + z0 * x1 + w0 * y1,
        x0 * y1 - y0 * x1 + z0 * w1 + w0 * z1,
    ]
    return np.stack(product, axis=-1)


def inverse(quat: np.ndarray) -> np.ndarray:
    """Return the inverses of unit quaternions [..., 4]."""
    return quat * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return ``vector[3]`` turned by each of ``quat[..., 4]``: [..., 3]."""
    padded = np.concatenate([[0.0], vector])
    return multiply(multiply(quat, padded), inverse(quat))[..., 1:]


def yaw(quat: np.ndarray) -> np.ndarray:
    """Return the yaw of quaternions [..., 4], in rad within [-pi, pi]."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    # Not y**2, which is y * y: the reference takes powers of single numbers, which are off by 1 ulp now and then.
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (np.float_power(y, 2) + np.float_power(z, 2)))


def from_yaw(angle: np.ndarray) -> np.ndarray:
    """Return the quaternions [..., 4] of turns by ``angle[...]`` (rad) about the vertical."""
    squared = angle * angle
    small = squared < 1e-10
    size = np.where(small, 1.0, np.sqrt(squared))
    real = np.where(small, 1.0 - squared / 8.0 + squared * squared / 384.0, np.cos(0.5 * size))
    imaginary = np.where(small, 0.5 - squared / 48.0 + squared * squared / 3840.0, np.sin(0.5 * size) / size)
    zero = imaginary * 0.0
    return np.stack([real, zero, zero, imaginary * angle], axis=-1)


def from_matrices(mats: np.ndarray) -> np.ndarray:
    """Return the quaternions float64[n, 4] of rotation matrices [n, 9], as MuJoCo computes them."""
    quats = np.empty((len(mats), 4))
    for quat, mat in zip(quats, mats, strict=True):
        mujoco.mju_mat2Quat(quat, mat)
    return quats
