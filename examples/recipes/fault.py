"""A fault of the loopback rig: the camera's pictures are upside down, as after somebody has turned its mount.

The kind goes into `KINDS` in `drivers/sim/faults.py`, what it does into the simulator of its device; for a fault
of single pictures that is `SPOILED` in `drivers/sim/scene.py`. `brushloop sim fault` knows it at once.
`docs/faults.md` says what a run makes of it; `tests/collect/faults/test_matrix.py` holds that.
"""

from __future__ import annotations

import cv2
import numpy as np

from brushloop.drivers.sim.faults import KINDS, Device
from brushloop.drivers.sim.scene import SPOILED


def upside_down(jpeg: bytes) -> bytes:
    """The picture turned by half a turn."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return cv2.imencode(".jpg", cv2.rotate(image, cv2.ROTATE_180))[1].tobytes()


def add() -> None:
    """Make the kind known; in the product these two lines stand in the tables themselves."""
    KINDS[Device.CAMERA] |= {"upside-down"}
    SPOILED["upside-down"] = upside_down
