"""The tables `[touch]`, `[self_check]` and `[quality]` of `rig.toml`: how the paper is found, and what is refused."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from brushloop.collect.rig.config_file import Config, Finite, Positive

Method = Literal["taught", "force", "camera", "jog"]
Level = Annotated[float, Field(ge=0.0, le=255.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Area = Annotated[float, Field(gt=0.0, le=1e6)]


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

    def check_points(self, size_mm: tuple[float, float]) -> None:
        """Raise ValueError where a point does not lie on a sheet of that size; for the validator of `rig.toml`."""
        for x, y in self.points_mm:
            if not (0.0 <= x <= size_mm[0] and 0.0 <= y <= size_mm[1]):
                raise ValueError(f"touch.points_mm: [{x:g}, {y:g}] does not lie on the sheet")

    @model_validator(mode="after")
    def _points(self) -> TouchConfig:
        if self.method == "camera" and len(self.points_mm) < 3:
            # Over the length of a row, a sheet that leans by 1 deg changes its height by more than a fine step.
            raise ValueError(f"points_mm has {len(self.points_mm)} points: by camera three are needed")
        return self


class SelfCheckConfig(Config):
    """Three marks at the corners of an uneven triangle, found by the camera, before a session."""

    enabled: bool | None = None
    """If left out, it is on where real hardware may move: with `--arm`, or an arm that is not on this machine."""
    depth_mm: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    legs_mm: tuple[Annotated[float, Field(ge=8.0, le=200.0)], Annotated[float, Field(ge=8.0, le=200.0)]] = (24.0, 15.0)
    """Legs of the triangle along paper x and y, on sheets without room for one over three patches; unequal, so that no
    corner is mistaken for another."""
    offset_mm: Positive = 3.0
    """How far the marks may lie, on average, from where they were commanded; a soft tip lands beside its axis."""
    turn_deg: Positive = 1.0
    scale: Annotated[float, Field(gt=0.0, le=0.2)] = 0.01
    """Largest relative error of a length, on top of what one mark's own scatter explains over the triangle's extent."""

    @model_validator(mode="after")
    def _uneven(self) -> SelfCheckConfig:
        x_mm, y_mm = self.legs_mm
        if not 1.3 * y_mm <= x_mm:
            raise ValueError(f"legs_mm = [{x_mm:g}, {y_mm:g}]: the first must be 1.3 times the second or more")
        return self


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
