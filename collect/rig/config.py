"""`rig.toml`: frozen and complete; an error is one line that names file, field and range.

The environment overrides any value: `BRUSHLOOP_ROBOT__HOST=192.0.2.7` sets `[robot] host`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import Field, ValidationError, model_validator

from brushloop.calibrate.board.lens import Lens, read_lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config_file import Config, PaperSide, Positive, read_toml, refusal
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.camera import CameraTable
from brushloop.drivers.force.sri_m8123 import ForceTable
from brushloop.drivers.ink import AnyInkTable
from brushloop.drivers.limits import Finite, Limits
from brushloop.sessions.errors import InputError

PREFIX, DELIMITER = "BRUSHLOOP_", "__"
TRAVEL_CLEARANCE_MM = 15.0
"""Minimum travel height above the paper: more than the length of a drop hanging from the tip."""
Method = Literal["taught", "force", "camera", "jog"]
Level = Annotated[float, Field(ge=0.0, le=255.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Area = Annotated[float, Field(gt=0.0, le=1e6)]


class RobotConfig(ArcsTable, frozen=True):
    """The arm, and where it may go."""

    limits: Limits


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


class ForceTouchConfig(Config):
    """Zero touch by force: fast steps until something is felt, then slow ones around that height."""

    fast_samples: Annotated[int, Field(ge=4, le=10_000)] = 60
    """Samples averaged at each rest of the fast approach."""
    medium_samples: Annotated[int, Field(ge=4, le=10_000)] = 80
    slow_samples: Annotated[int, Field(ge=10, le=100_000)] = 600
    """Samples averaged over the three rests of one slow descent."""
    sigma_mm: Annotated[float, Field(ge=0.001, le=0.5)] = 0.04
    """Slow descents are repeated until the contact is known to this standard error; three touches average to 0.6 of
    it."""
    push_axis: tuple[Finite, Finite, Finite] = (0.0, 0.0, -1.0)
    """Direction of the paper's push in the sensor's frame: against its z axis if that points along the tool to the
    tip."""
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.05
    """Time from the arm at rest to the first sample that counts."""

    @model_validator(mode="after")
    def _axis(self) -> ForceTouchConfig:
        if sum(v * v for v in self.push_axis) < 1e-6:
            raise ValueError("push_axis must not be zero")
        return self


class TouchConfig(Config):
    """How the height is found from which H is counted (docs/zero-touch.md)."""

    method: Method = "taught"
    """`taught` visits the height of `[paper]` and confirms it; the others measure."""
    touches: Annotated[int, Field(ge=1, le=50)] = 3
    """Number of touches at each point."""
    repeatability_mm: Positive = 0.15
    """How far the touches of one point may spread, or five of their standard errors if that is more; beyond it the run
    stops and names the heights."""
    residual_mm: Positive = 0.2
    """How far a point may lie from the plane through all of them; three points have no residuals."""
    above_mm: Annotated[float, Field(gt=0.0, le=20.0)] = 2.0
    """How far above the expected height the approach begins: more than the error of that height."""
    travel_mm: Annotated[float, Field(gt=0.0, le=20.0)] = 2.0
    """How far below the expected height the approach ends if nothing is touched."""
    moved_mm: Positive = 0.5
    """A height measured this far from the one before is doubtful, and is pointed out in the set-up."""
    lean_deg: Annotated[float, Field(ge=0.0, le=3.0)] = 1.0
    """How much the sheet may lean: far from the last touch, the approach is widened accordingly."""
    points_mm: Annotated[list[tuple[Finite, Finite]], Field(max_length=25)] = Field(
        default_factory=list[tuple[float, float]]
    )
    """Where to touch, in the paper frame; empty means `[paper] touch_point_mm`. Three or more give a plane, fewer a
    level sheet. By camera each point is the lower left of a patch that gets inked, and three are needed."""
    speed_mm_s: Annotated[float, Field(ge=0.5, le=50.0)] = 5.0
    """Speed of every move at or below the start of the approach."""
    force: ForceTouchConfig = ForceTouchConfig()

    @model_validator(mode="after")
    def _points(self) -> TouchConfig:
        if self.method == "camera" and len(self.points_mm) < 3:
            # Over the length of a row, a sheet that leans by 1 deg changes its height by more than a fine step.
            raise ValueError(f"points_mm has {len(self.points_mm)} points; zero touch by camera needs three")
        return self


class SelfCheckConfig(Config):
    """Three marks at the corners of an uneven triangle, found by the camera, before a session."""

    enabled: bool | None = None
    """If left out, it is on where real hardware may move: with `--arm`, or an arm that is not on this machine."""
    depth_mm: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    offset_mm: Positive = 3.0
    """How far the marks may lie, on average, from where they were commanded; a soft tip lands beside its axis."""
    turn_deg: Positive = 1.0
    scale: Annotated[float, Field(gt=0.0, le=0.2)] = 0.01
    """Largest relative error of a length, on top of what one mark's own scatter explains over the triangle's extent."""


class QualityConfig(Config):
    """Limits beyond which a capture is not sound. `docs/quality.md` says what each measures and why it is there."""

    enabled: bool = True
    """False records captures without judging them."""
    retakes: Annotated[int, Field(ge=0, le=10)] = 2
    """How often a stroke that failed is pressed again on a new patch before a person is asked."""
    dark_level: Level = 80.0
    """Gray level of the paper below which the picture is underexposed."""
    bright_level: Annotated[float, Field(ge=0.0, le=256.0)] = 250.0
    """Gray level of the paper from which the picture is overexposed, its pixels saturated. 256 = never."""
    blur_mm: Length = 0.25
    """Standard deviation of the blur on the paper, measured at the picture's steepest edges."""
    edge_mm: Length = 1.0
    """Least distance of ink from the edge of the frame: nearer ink may go on beyond it."""
    glare_share: Share = 0.1
    """How much brighter than the paper around it a spot must be to count as glare."""
    glare_mm2: Area = 6.0
    """Area of glare in the patch."""
    ink_gate: Share = 0.1
    """How far below the paper a spot must lie to count as ink, as a share of the paper's brightness."""
    foreign_mm2: Area = 1.5
    """Ink in the patch that is not the stroke's own; a patch that holds this much before a press is not blank."""
    blank_mm2_per_mm: Area = 0.1
    """A press that leaves less ink for each mm of its depth is blank."""
    uneven: Share = 0.125
    """Standard deviation of the darkness within a stroke, as a share of its mean, from which it counts as dry."""
    head_mm: Annotated[float, Field(ge=-20.0, le=20.0)] = 0.7
    """How far a sound mark begins behind the zero-touch point, on the side away from its tip."""
    misplaced_mm: Length = 1.6
    """Distance of the mark's head from where it should begin."""
    smeared_mm: Length = 4.0
    """How much longer than 1.6 times its depth, or wider than 0.65 times, a mark may be."""
    faint_tone: Share = 0.77
    """Darkness of the ink, 1 = reflects nothing, below which it is faint."""
    split_mm: Length = 0.3
    """Gap between two groups of hairs, averaged over 2 mm of its length."""
    bent_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 5.5
    """Angle between the heading and the direction of the mark from its head to its tip."""

    @model_validator(mode="after")
    def _ordered(self) -> QualityConfig:
        if self.dark_level >= self.bright_level:
            raise ValueError(f"dark_level = {self.dark_level:g} must be less than bright_level = {self.bright_level:g}")
        return self


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
        host = self.robot.host
        on_this_machine = host in ("localhost", "::1") or host.startswith("127.")  # as the loopback rig is
        enabled = armed or not on_this_machine
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
                f"ink.wipe.z_mm = {wipe.z_mm:g} must lie in [{self.ink.dip_z_mm:g}, {self.motion.safe_z_mm:g}): "
                "between the dip and travel height"
            )
        touched = {"touch.points_mm": self.touch.points_mm, "paper.touch_point_mm": [self.paper.touch_point_mm]}
        for name, points_mm in touched.items():
            for x, y in points_mm:
                if not (0.0 <= x <= width and 0.0 <= y <= height):
                    raise ValueError(f"{name}: [{x:g}, {y:g}] does not lie on the sheet")
        return self


def overrides() -> dict[tuple[str, ...], str]:
    """Map each path to the variable that sets it: `("robot", "port")` -> `BRUSHLOOP_ROBOT__PORT`."""
    names = (name for name in sorted(os.environ) if name.upper().startswith(PREFIX))
    return {tuple(name[len(PREFIX) :].lower().split(DELIMITER)): name for name in names}


def _override(values: dict[str, Any], path: tuple[str, ...], name: str) -> None:
    """Set the field at this path to what the variable holds: lists and tables as JSON, all else as it is."""
    table, variable = values, f"environment variable {name}"
    for part in path[:-1]:
        inner: Any = table.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ConfigError(variable, ".".join(path), "belongs to no table of rig.toml")
        table = cast("dict[str, Any]", inner)
    text = os.environ[name]
    try:
        table[path[-1]] = json.loads(text) if text.startswith(("[", "{")) else text
    except (ValueError, RecursionError):
        shown = text if len(text) <= 80 else f"{text[:77]}..."
        raise ConfigError(variable, ".".join(path), f"is not JSON, such as [40.0, 24.0] (given: {shown!r})") from None


def load_rig(path: Path) -> RigConfig:
    """Read `rig.toml` and its lens file, with overrides from the environment. Raises `ConfigError`."""
    if not path.exists():
        raise ConfigError(path, "", "no such file: `brushloop rig new` and `brushloop sim --write-rig` make one")
    values, environment = read_toml(path), overrides()
    if "kind" in values and "robot" not in values:
        raise ConfigError(path, "", "is a protocol, not a rig: give it to --protocol, and the rig to --config")
    for field, name in environment.items():
        _override(values, field, name)
    return rig_from(path, values, environment)


def rig_from(path: Path, values: dict[str, Any], environment: Mapping[tuple[str, ...], str] | None = None) -> RigConfig:
    """The rig that these tables describe, with the lens in a file beside `path`. Raises `ConfigError`.

    `environment` maps the path of each value that the environment sets to its variable.
    """
    try:
        rig = RigConfig.model_validate(values)
        if (lens_file := rig.camera.lens_file) is None:
            return rig
        optics = read_lens(path.parent / lens_file)
    except ValidationError as error:
        raise refusal(path, error, RigConfig, environment=environment) from None
    except InputError as error:
        raise ConfigError(path, "camera.lens_file", str(error)) from None
    return rig.model_copy(update={"camera": rig.camera.model_copy(update={"optics": optics})})
