"""The humanoid's mirror image: left and right exchanged, in a vertical mirror along the commanded direction.

The mirror image of a symmetric body's step is another valid step, so each transition yields two (Abdolhosseini et al.
2019, "On Learning Symmetric Locomotion"). The signs and pairs below follow from the joint axes in the model; a test
steps a body and its image.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

# Joints: abdomen z, y, x; right leg hip x, z, y, knee, ankle y, x; left leg; right arm shoulder 1, 2, elbow; left arm.
_JOINT_OF_IMAGE = np.array([0, 1, 2, *range(9, 15), *range(3, 9), *range(18, 21), *range(15, 18)])
_JOINT_SIGN = np.array([-1, 1, -1, *[1, 1, 1, 1, 1, -1] * 2, *[-1, -1, 1] * 2], np.float32)

HUMANOID_ACTUATED = np.array([1, 0, 2, 3, 4, 5, 6, 8, 7, 9, 10, 11, 12, 14, 13, *range(15, 21)])
"""Index of the joint (without the root) that each of the 21 motors turns."""

_MOTOR_OF_JOINT = np.argsort(HUMANOID_ACTUATED)
_MOTOR_OF_IMAGE = _MOTOR_OF_JOINT[_JOINT_OF_IMAGE[HUMANOID_ACTUATED]]
_MOTOR_SIGN = _JOINT_SIGN[HUMANOID_ACTUATED]

# A view: height, two axes of the body, joints, linear velocity, angular velocity (whose sign a mirror flips), joint
# velocities.
_VIEW_OF_IMAGE = np.array([*range(7), *(7 + _JOINT_OF_IMAGE), *range(28, 34), *(34 + _JOINT_OF_IMAGE)])
_VIEW_SIGN = np.array([1, *[1, -1, 1] * 2, *_JOINT_SIGN, 1, -1, 1, -1, 1, -1, *_JOINT_SIGN], np.float32)


def mirrored_view(view: jax.Array) -> jax.Array:
    """Return the mirror image of a ``humanoid_view[..., 55]``."""
    return jnp.asarray(view)[..., _VIEW_OF_IMAGE] * _VIEW_SIGN


def mirrored_action(action: jax.Array) -> jax.Array:
    """Return the mirror image of ``action[..., 21]``, either torques or joint targets."""
    return jnp.asarray(action)[..., _MOTOR_OF_IMAGE] * _MOTOR_SIGN
