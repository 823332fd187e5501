"""What the loopback controller says of its arm's limits, and how fast it lets the arm go.

Speeds of the joints are those of the maker's URDF for the i5; the other maxima are the examples of the SDK's headers,
which are for an i5H. A real cabinet tells its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from drivers.sim.arm.kinematics import A_M, ALPHA_DEG, D_M, HOME, LIMITS_DEG, THETA_DEG

JOINT_SPEEDS_RAD_S = (2.5964, 2.5964, 2.5964, 3.1105, 3.1105, 3.1105)
JOINT_ACCS_RAD_S2 = (31.1, 31.1, 31.1, 20.7, 20.7, 20.7)
TCP_SPEED_M_S, TCP_TURN_RAD_S = 2.0, 5.0
TCP_ACC_M_S2, TCP_TURN_RAD_S2 = 10.0, 10.0
REDUCED_M_S = 0.25
"""Reduced mode and manual operation: ISO 10218-1 calls 250 mm/s reduced speed. A real cabinet is configured."""
REACH_M = 0.8865
REDUCED_RAD_S = REDUCED_M_S / REACH_M
"""So slow that the tip of the stretched arm keeps to it."""

Params = dict[str, Any]


def tables() -> dict[str, Callable[[Params], Any]]:
    """By `RobotConfig.method`."""
    positions = [math.radians(v) for v in LIMITS_DEG]
    table: dict[str, Callable[[Params], Any]] = {
        "RobotConfig.getKinematicsParam": lambda _: {
            "a": A_M,
            "alpha": [math.radians(v) for v in ALPHA_DEG],
            "beta": [0.0] * 6,
            "d": D_M,
            "theta": [math.radians(v) for v in THETA_DEG],
        },
        "RobotConfig.getHomePosition": lambda _: HOME,
        "RobotConfig.getTcpMaxSpeeds": lambda _: [TCP_SPEED_M_S, TCP_TURN_RAD_S],
        "RobotConfig.getTcpMaxAccelerations": lambda _: [TCP_ACC_M_S2, TCP_TURN_RAD_S2],
        "RobotConfig.getLimitTcpMaxSpeed": lambda _: TCP_SPEED_M_S,
    }
    for name in ("Joint", "LimitJoint"):
        table |= {
            f"RobotConfig.get{name}MaxPositions": lambda _: positions,
            f"RobotConfig.get{name}MinPositions": lambda _: [-v for v in positions],
            f"RobotConfig.get{name}MaxSpeeds": lambda _: JOINT_SPEEDS_RAD_S,
            f"RobotConfig.get{name}MaxAccelerations": lambda _: JOINT_ACCS_RAD_S2,
        }
    return table
