"""The lens of the rig's camera: read beside `rig.toml`, and undone before anything is measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibrate.board.artefact import read_lens
from calibrate.board.lens import Lens
from calibrate.errors import CalibrationError
from collect.errors import ConfigError, StepError
from collect.rig.config_devices import CameraConfig

Gray = NDArray[np.uint8]


def with_optics(rig_path: Path, camera: CameraConfig) -> CameraConfig:
    """The same camera with what stands in its lens file, looked for beside `rig.toml`. Raises `ConfigError`."""
    if camera.lens_file is None:
        return camera
    try:
        optics = read_lens(rig_path.parent / camera.lens_file)
    except CalibrationError as error:
        raise ConfigError(rig_path, "camera.lens_file", str(error)) from None
    return camera.model_copy(update={"optics": optics})


def lens_of(camera: CameraConfig) -> Lens | None:
    """None for a camera whose lens is taken to be straight."""
    return None if camera.optics is None else camera.optics.lens()


def straightened(camera: CameraConfig, image: Gray) -> Gray:
    """An (h, w) photograph without what the lens bends; what is recorded stays as it was taken.

    Raises `StepError` where the camera no longer gives photographs of the size that its lens was calibrated at.
    """
    lens = lens_of(camera)
    if lens is None:
        return image
    height, width = image.shape[:2]
    if (width, height) != lens.size_px:
        raise StepError(
            f"the camera gives {width} x {height} px, its lens was calibrated at {lens.size_px[0]} x {lens.size_px[1]} "
            "px: set camera.locked, or calibrate the lens at this size"
        )
    return lens.undistort(image)
