"""The lens of the rig's camera, from a file beside `rig.toml`; distortion is removed before anything is measured."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Lens, read_lens
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import ConfigError, StepError
from brushloop.drivers.camera import CameraTable

Gray = NDArray[np.uint8]


class CameraConfig(CameraTable, frozen=True):
    """The camera, and its lens."""

    lens: str = ""
    """Name of the lens, for the record."""
    lens_file: Path | None = None
    """Written by `brushloop camera intrinsics`, beside rig.toml: distortion is removed before anything is measured."""
    optics: Lens | None = None
    """Contents of that file; filled in when rig.toml is read, so that the session holds them."""


def with_optics(rig_path: Path, camera: CameraConfig) -> CameraConfig:
    """The same camera with its lens, read from a file beside `rig.toml`. Raises `ConfigError`."""
    if camera.lens_file is None:
        return camera
    try:
        optics = read_lens(rig_path.parent / camera.lens_file)
    except CalibrationError as error:
        raise ConfigError(rig_path, "camera.lens_file", str(error)) from None
    return camera.model_copy(update={"optics": optics})


def gray(image: NDArray[np.uint8]) -> Gray:
    """(h, w) of an (h, w) or (h, w, 3) BGR image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def undistorted(camera: CameraConfig, photograph: NDArray[np.uint8]) -> Gray:
    """An (h, w) or (h, w, 3) BGR photograph in gray, without the lens distortion that recordings keep.

    Raises `StepError` if photographs no longer have the size at which the lens was calibrated.
    """
    image = gray(photograph)
    lens = camera.optics
    if lens is None:
        return image
    height, width = image.shape[:2]
    if (width, height) != lens.size_px:
        raise StepError(
            f"the camera gives {width} x {height} px, its lens was calibrated at {lens.size_px[0]} x {lens.size_px[1]} "
            "px: set camera.locked, or calibrate the lens at this size"
        )
    return lens.undistort(image)
