"""The tables `[touch]`, `[self_check]` and `[quality]` of `rig.toml`: how the paper is found, and what is refused."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from brushloop.collect.rig.config_file import Config, Finite, Positive

Method = Literal["taught", "force", "camera", "jog"]
Step = Annotated[float, Field(ge=0.01, le=5.0)]
Level = Annotated[float, Field(ge=0.0, le=255.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Area = Annotated[float, Field(gt=0.0, le=1e6)]


class ForceTouchConfig(Config):
    """Zero touch by force: fast steps until something is felt, then slow ones around that height."""

    threshold_n: Positive = 0.0012
    """Force in N that ends the fast approach. A soft brush pushes with a few mN in its first millimetre."""
    fast_step_mm: Step = 0.5
    fast_samples: Annotated[int, Field(ge=4, le=10_000)] = 60
    """Samples averaged at each rest of the fast approach."""
    medium_step_mm: Step = 0.15
    medium_samples: Annotated[int, Field(ge=4, le=10_000)] = 80
    slow_samples: Annotated[int, Field(ge=10, le=100_000)] = 600
    """Samples averaged over the three rests of one slow descent."""
    sigma_mm: Annotated[float, Field(ge=0.001, le=0.5)] = 0.04
    """Slow descents are repeated until the contact is known to this standard error; three touches average to 0.6 of
    it."""
    max_samples: Annotated[int, Field(ge=100, le=1_000_000)] = 60_000
    """Most samples of one touch; if they are not enough, the sensor is too noisy for the brush."""
    linear_mm: Annotated[float, Field(ge=0.05, le=5.0)] = 0.45
    """Depth to which the brush counts as a linear spring; readings below it are left out."""
    push_axis: tuple[Finite, Finite, Finite] = (0.0, 0.0, -1.0)
    """Direction of the paper's push in the sensor's frame: against its z axis if that points along the tool to the
    tip."""
    clear_mm: Annotated[float, Field(ge=0.0, le=20.0)] = 1.0
    """A rest above the previous one is approached from this much higher: every rest is reached on the way down."""
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.05
    """Time from the arm at rest to the first sample that counts."""

    @model_validator(mode="after")
    def _axis(self) -> ForceTouchConfig:
        if sum(v * v for v in self.push_axis) < 1e-6:
            raise ValueError("push_axis must not be zero")
        return self


class CameraTouchConfig(Config):
    """Zero touch by first ink: rows of shallow touches, each a little lower, and a photograph of each row."""

    coarse_step_mm: Step = 0.5
    fine_step_mm: Step = 0.08
    """Step of the fine rows; the error of a touch is about half of it."""
    pitch_mm: Annotated[float, Field(ge=2.0, le=20.0)] = 4.0
    """Distance between spots; a shallow touch leaves a mark of one to three millimetres. Camera and arm must agree on
    the place within a quarter of it."""
    columns: Annotated[int, Field(ge=2, le=50)] = 9
    """Spots in a row of a point's patch."""
    spots_per_dip: Annotated[int, Field(ge=1, le=20)] = 2
    """Touches after which the brush is dipped again: a tip that dries leaves no ink at first."""
    spots_per_photo: Annotated[int, Field(ge=1, le=20)] = 2
    """Touches per photograph in the coarse row, which ends when ink is seen; few, so that spots stay small."""
    least_ink_mm2: Annotated[float, Field(gt=0.0, le=10.0)] = 0.25
    """Darkening that counts as ink: area times how much darker it became, 1 being black."""

    @property
    def extent_mm(self) -> float:
        """Length of a row of touches."""
        return (self.columns - 1) * self.pitch_mm


class JogTouchConfig(Config):
    """Zero touch by the operator's jog."""

    steps_mm: tuple[Step, Step, Step] = (0.02, 0.1, 1.0)


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
    camera: CameraTouchConfig = CameraTouchConfig()
    jog: JogTouchConfig = JogTouchConfig()

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
    """If left out, it is on where real hardware may move (with `--arm`, or an arm that is not on this machine); a
    resumed session keeps the setting with which it began."""
    depth_mm: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    legs_mm: tuple[Annotated[float, Field(ge=8.0, le=200.0)], Annotated[float, Field(ge=8.0, le=200.0)]] = (24.0, 15.0)
    """Legs of the triangle along paper x and y, on sheets without room for one over three patches; unequal, so that no
    corner is mistaken for another."""
    offset_mm: Positive = 3.0
    """How far the marks may lie, on average, from where they were commanded; a soft tip lands beside its axis."""
    turn_deg: Positive = 1.0
    scale: Annotated[float, Field(gt=0.0, le=0.2)] = 0.01
    """Largest relative error of a length, on top of `mark_mm` divided by the triangle's extent."""
    mark_mm: Positive = 0.3
    """How far one mark's centre may lie from where the others imply: no two presses bend the hairs alike. To
    distinguish 2 % from 1 %, a triangle must extend over more than 50 mm along both axes."""
    least_ink_mm2: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0

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
