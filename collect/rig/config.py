"""`rig.toml`: frozen and complete; an error is one line that names file, field and range.

The environment overrides any value: `BRUSHLOOP_ROBOT__HOST=192.0.2.7` sets `[robot] host`.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import Field, ValidationError, model_validator

from brushloop.calibrate.board.lens import Lens, read_lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config_file import Config, Finite, PaperSide, Range, place, read_toml, refusal
from brushloop.collect.rig.config_touch import QualityConfig, SelfCheckConfig, TouchConfig
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.camera import CameraTable
from brushloop.drivers.force.sri_m8123 import ForceTable
from brushloop.drivers.ink import AnyInkTable

PREFIX, DELIMITER = "BRUSHLOOP_", "__"
MAX_CONFIG_BYTES = 1024 * 1024
TRAVEL_CLEARANCE_MM = 15.0
"""Minimum travel height above the paper: more than the length of a drop hanging from the tip."""


class LimitsConfig(Config):
    """The region that the brush tip must never leave, in the robot's base frame."""

    x_mm: Range
    y_mm: Range
    z_mm: Range
    """The lower end is the floor: paper height minus the deepest press."""
    tilt_deg: Annotated[float, Field(gt=0.0, le=30.0)] = 15.0
    speed_mm_s: Annotated[float, Field(gt=0.0, le=500.0)] = 250.0
    acc_mm_s2: Annotated[float, Field(gt=0.0, le=5000.0)] = 1000.0

    @model_validator(mode="after")
    def _ordered(self) -> LimitsConfig:
        for name in ("x_mm", "y_mm", "z_mm"):
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name} = [{low}, {high}]: the first must be less than the second")
        return self


class RobotConfig(ArcsTable, frozen=True):
    """The arm, and where it may go."""

    limits: LimitsConfig

    @property
    def on_this_machine(self) -> bool:
        """Whether its controller has a loopback address, as the loopback rig's has."""
        return self.host in ("localhost", "::1") or self.host.startswith("127.")


class CameraConfig(CameraTable, frozen=True):
    """The camera, and its lens."""

    lens: str = ""
    """Name of the lens, for the record."""
    lens_file: Path | None = None
    """Written by `brushloop camera intrinsics`, beside rig.toml: distortion is removed before anything is measured."""
    optics: Lens | None = None
    """Contents of that file; filled in when rig.toml is read, so that the session holds them."""


class BrushConfig(Config):
    """The brush that is mounted."""

    name: str
    radius_mm: Annotated[float, Field(gt=0.0, le=50.0)] = 6.0
    length_mm: Annotated[float, Field(gt=0.0, le=200.0)] = 48.0
    max_depth_mm: Annotated[float, Field(gt=0.0, le=100.0)] = 22.0
    """Deepest press that this brush can take."""


class PaperConfig(Config):
    """The sheet and where it lies. The paper frame is right-handed, z up, origin at the lower left corner."""

    name: str = "Xuan paper"
    origin_mm: tuple[Finite, Finite]
    """Lower left corner in the base frame."""
    yaw_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    """Angle from base x to paper x."""
    touch_z_mm: Finite
    """Height in the base frame at which the tip of the vertical brush just touches: taught by the operator."""
    size_mm: tuple[PaperSide, PaperSide]
    cell_mm: tuple[PaperSide, PaperSide] = (40.0, 24.0)
    """Width and height of the patch for one press."""
    touch_point_mm: tuple[Finite, Finite] = (4.0, 4.0)
    """Where each run first goes to the taught height, in the paper frame; clear of every patch's ink."""


class WipeConfig(Config):
    """Wipes a drop off at the rim of the well after each dip."""

    rim_mm: tuple[Finite, Finite]
    """Where the wipe from the middle of the well across its rim ends; in the paper frame, off the sheet."""
    z_mm: Finite
    """Height of the tip during the wipe, in the base frame: a little below the rim."""


class WashConfig(Config):
    """A pot of water, for a brush that dries in a long session."""

    pot_mm: tuple[Finite, Finite]
    """Its centre, in the paper frame; off the sheet."""
    dip_z_mm: Finite
    """Height of the tip at the bottom, in the base frame."""
    every_dips: Annotated[int, Field(ge=1, le=1000)] = 30
    """The brush is washed before each dip whose number, from 1, is a multiple of this."""
    strokes: Annotated[int, Field(ge=1, le=20)] = 3
    """Number of times the brush goes down and up."""


class InkConfig(Config):
    """The ink well."""

    name: str = "ink"
    well_mm: tuple[Finite, Finite]
    """Centre, in the paper frame."""
    dip_z_mm: Finite
    """Height of the tip at the bottom of a dip, in the base frame."""
    wipe: WipeConfig | None = None
    wash: WashConfig | None = None
    device: AnyInkTable | None = None
    """The device that keeps the well filled; if left out, the operator does."""


class MotionConfig(Config):
    """Heights and speeds."""

    safe_z_mm: Finite
    """Travel height in the base frame."""
    park_mm: tuple[Finite, Finite, Finite]
    """Where the arm waits, out of the camera's view, in the base frame."""
    travel_speed_mm_s: Annotated[float, Field(gt=0.0, le=500.0)] = 150.0
    press_speed_mm_s: Annotated[float, Field(gt=0.0, le=100.0)] = 20.0
    acc_mm_s2: Annotated[float, Field(gt=0.0, le=5000.0)] = 500.0
    least_dwell_s: Annotated[float, Field(ge=0.05, le=60.0)] = 0.1
    """Minimum time at depth, even if a shorter dwell is configured: the depth must be observed."""


class RigConfig(Config):
    """`rig.toml`, with the overrides of the environment."""

    name: str
    robot: RobotConfig
    camera: CameraConfig
    force: ForceTable | None = None
    brush: BrushConfig
    paper: PaperConfig
    ink: InkConfig
    board: BoardSpec
    motion: MotionConfig
    touch: TouchConfig = TouchConfig()
    self_check: SelfCheckConfig = SelfCheckConfig()
    quality: QualityConfig = QualityConfig()

    def settled(self, armed: bool) -> RigConfig:
        """Return a copy that decides the self-check if it was left out: on wherever real hardware may move."""
        if self.self_check.enabled is not None:
            return self
        enabled = armed or not self.robot.on_this_machine
        return self.model_copy(update={"self_check": self.self_check.model_copy(update={"enabled": enabled})})

    @model_validator(mode="after")
    def _clear_of_the_paper(self) -> RigConfig:
        lowest_mm = self.paper.touch_z_mm + TRAVEL_CLEARANCE_MM
        if self.motion.safe_z_mm < lowest_mm:
            raise ValueError(
                f"motion.safe_z_mm = {self.motion.safe_z_mm:g} is below {lowest_mm:g} mm: "
                f"travel must clear the paper (paper.touch_z_mm) by {TRAVEL_CLEARANCE_MM:g} mm"
            )
        if self.motion.park_mm[2] < self.motion.safe_z_mm:
            raise ValueError(f"motion.park_mm[2] = {self.motion.park_mm[2]:g} is below motion.safe_z_mm")
        width, height = self.paper.size_mm
        wipe, wash = self.ink.wipe, self.ink.wash
        places = {"ink.well_mm": self.ink.well_mm}
        places |= {"ink.wipe.rim_mm": wipe.rim_mm} if wipe is not None else {}
        places |= {"ink.wash.pot_mm": wash.pot_mm} if wash is not None else {}
        for name, (x, y) in places.items():
            if 0.0 <= x <= width and 0.0 <= y <= height:
                raise ValueError(f"{name} = [{x:g}, {y:g}] lies on the sheet: dips would press on it")
        if wipe is not None and not self.ink.dip_z_mm <= wipe.z_mm < self.motion.safe_z_mm:
            raise ValueError(
                f"ink.wipe.z_mm = {wipe.z_mm:g} is outside [{self.ink.dip_z_mm:g}, {self.motion.safe_z_mm:g}): "
                "between the dip and travel"
            )
        self.touch.check_points(self.paper.size_mm)
        x, y = self.paper.touch_point_mm
        if not (0.0 <= x <= width and 0.0 <= y <= height):
            raise ValueError(f"paper.touch_point_mm = [{x:g}, {y:g}] does not lie on the sheet")
        return self


def overrides() -> dict[tuple[str, ...], str]:
    """Map each path to the variable that sets it: `("robot", "port")` -> `BRUSHLOOP_ROBOT__PORT`."""
    names = (name for name in sorted(os.environ) if name.upper().startswith(PREFIX))
    return {tuple(name[len(PREFIX) :].lower().split(DELIMITER)): name for name in names}


def _override(values: dict[str, Any], path: tuple[str, ...], name: str) -> None:
    """Set the field at this path to what the variable holds: lists and tables as JSON, all else as it is."""
    table = values
    for part in path[:-1]:
        inner: Any = table.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ConfigError(place(name), ".".join(path), "lies in no table of rig.toml")
        table = cast("dict[str, Any]", inner)
    text = os.environ[name]
    try:
        table[path[-1]] = json.loads(text) if text.startswith(("[", "{")) else text
    except (ValueError, RecursionError):
        shown = text if len(text) <= 80 else f"{text[:77]}..."
        raise ConfigError(place(name), ".".join(path), f"is not JSON, as [40.0, 24.0] is (given: {shown!r})") from None


def load_rig(path: Path) -> RigConfig:
    """Read `rig.toml` and its lens file, with overrides from the environment. Raises `ConfigError`."""
    values, environment = read_toml(path, MAX_CONFIG_BYTES), overrides()
    for field, name in environment.items():
        _override(values, field, name)
    try:
        rig = RigConfig.model_validate(values)
    except ValidationError as error:
        raise refusal(path, error, RigConfig, environment=environment) from None
    return rig.model_copy(update={"camera": with_optics(path, rig.camera)})


def with_optics(rig_path: Path, camera: CameraConfig) -> CameraConfig:
    """The same camera with its lens, read from a file beside `rig.toml`. Raises `ConfigError`."""
    if camera.lens_file is None:
        return camera
    try:
        optics = read_lens(rig_path.parent / camera.lens_file)
    except CalibrationError as error:
        raise ConfigError(rig_path, "camera.lens_file", str(error)) from None
    return camera.model_copy(update={"optics": optics})
