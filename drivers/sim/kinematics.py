"""Kinematics of the i5 from its nominal table (modified DH).

The loopback controller answers FK and IK with it. A real arm is calibrated and differs by most of a millimetre, so the
driver always asks the controller.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import columns, of_matrix, unit, vector

Matrix = NDArray[np.float64]
Joints = tuple[float, ...]
"""Of the six joints, in rad."""

A_M = (0.0, 0.0, 0.408, 0.376, 0.0, 0.0)
ALPHA_DEG = (0.0, -90.0, 180.0, 180.0, -90.0, 90.0)
D_M = (0.122, 0.1215, 0.0, 0.0, 0.1025, 0.094)
THETA_DEG = (180.0, -90.0, 0.0, -90.0, 0.0, 0.0)
LIMITS_DEG = (175.0, 175.0, 175.0, 175.0, 175.0, 360.0)
"""Limits of the joints in both directions from zero."""
HOME: Joints = (0.0, math.radians(-15.0), math.radians(100.0), math.radians(25.0), math.radians(90.0), 0.0)

CLOSE_M, CLOSE_RAD = 1e-7, 1e-7
MAX_STEP_RAD = 0.3
ITERATIONS = 80
DAMPING = 1e-3
_OFFSETS_RAD = tuple(math.radians(theta) for theta in THETA_DEG)
_TWISTS = tuple((math.cos(math.radians(alpha)), math.sin(math.radians(alpha))) for alpha in ALPHA_DEG)


def _frames(q: Sequence[float]) -> Matrix:
    """(6, 4, 4) the joint frames in the base frame: T_i = Rx(alpha) Tx(a) Rz(q + theta) Tz(d)."""
    links: list[list[list[float]]] = []
    for (ca, sa), a_m, d_m, q_rad, offset_rad in zip(_TWISTS, A_M, D_M, q, _OFFSETS_RAD, strict=True):
        c, s = math.cos(q_rad + offset_rad), math.sin(q_rad + offset_rad)
        links.append(
            [[c, -s, 0.0, a_m], [ca * s, ca * c, -sa, -sa * d_m], [sa * s, sa * c, ca, ca * d_m], [0.0, 0.0, 0.0, 1.0]]
        )
    frames = np.array(links)
    for before, frame in itertools.pairwise(frames):
        frame[:] = before @ frame
    return frames


def forward(q: Sequence[float]) -> Matrix:
    """The flange in the base frame, metres, as a 4x4 matrix. Raises ValueError unless given six joints."""
    return _frames(q)[-1]


def inverse(target: Matrix, near: Sequence[float]) -> Joints | None:
    """Joints that bring the flange to `target`, searched from `near`, then from home turned toward the target.

    None if the search does not converge within the joint limits.
    """
    toward = math.atan2(target[1, 3], target[0, 3])
    for seed in (near, (toward, *HOME[1:]), (toward + 0.3, *HOME[1:])):
        q = _descend(target, np.array(seed, dtype=np.float64))
        if q is not None and (joints := _within(q, near)) is not None:
            return joints
    return None


def _descend(target: Matrix, q: Matrix) -> Matrix | None:
    """Solve by damped least squares; None if not converged after `ITERATIONS`."""
    for _ in range(ITERATIONS):
        frames = _frames(q.tolist())
        flange = frames[-1]
        shift = target[:3, 3] - flange[:3, 3]
        turn = vector(of_matrix((target[:3, :3] @ flange[:3, :3].T).tolist()))
        if np.linalg.norm(shift) < CLOSE_M and math.hypot(*turn) < CLOSE_RAD:
            return q
        x, y, z = axes = frames[:, :3, 2].T
        u, v, w = flange[:3, 3:] - frames[:, :3, 3].T
        jacobian = np.vstack([y * w - z * v, z * u - x * w, x * v - y * u, axes])
        error = np.concatenate([shift, turn])
        damping = DAMPING * min(1.0, float(np.linalg.norm(error)))
        square = jacobian @ jacobian.T + (damping * damping + 1e-12) * np.eye(6)  # never singular
        step = jacobian.T @ np.linalg.solve(square, error)
        q = q + step * min(1.0, MAX_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
    return None


def _within(q: Matrix, near: Sequence[float]) -> Joints | None:
    """Shift each joint by whole turns, as near to `near` as its limit allows."""
    joints: list[float] = []
    for value, close, limit_deg in zip(q.tolist(), near, LIMITS_DEG, strict=True):
        turns = [math.remainder(value, 2 * math.pi) + 2 * math.pi * k for k in (-1, 0, 1)]
        allowed = [v for v in turns if abs(v) <= math.radians(limit_deg)]
        if not allowed:
            return None
        joints.append(min(allowed, key=lambda v: abs(v - close)))
    return tuple(joints)


def matrix_of(pose: Pose) -> Matrix:
    """A pose (mm) as a 4x4 matrix (m)."""
    matrix: Matrix = np.eye(4)
    matrix[:3, :3] = np.transpose(columns(unit(pose.quaternion)))
    matrix[:3, 3] = np.array(pose.position_mm) / 1e3
    return matrix


def pose_of(matrix: Matrix) -> Pose:
    """A 4x4 matrix (m) as a pose (mm)."""
    x, y, z = (float(v) * 1e3 for v in matrix[:3, 3])
    return Pose(x, y, z, *of_matrix(matrix[:3, :3].tolist()))
