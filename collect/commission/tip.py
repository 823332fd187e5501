"""Step 3: the tip of the brush. The same pin is touched from many sides; the program only reads.

The tip in the flange's frame follows from flange poses at which it touched one and the same point, and the direction of
the brush from poses in which a person held it upright.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brushloop.collect.commission.arm import HAND_MM, tip_of, touch
from brushloop.collect.commission.visit import Notebook, Step, Taught, Visit
from brushloop.collect.errors import NotAccepted
from brushloop.collect.rig.check import brush_square
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance

Floats = NDArray[np.float64]
LEAST_TOUCHES = 4
WORST_CONDITION = 60.0
"""Above this the directions are so similar that errors of the touches appear many times larger in the length. If the
wrist turns along with the lean, all directions are the same: one side of the flange is always up."""
OUTLIER_SHARE = 4.0
"""A touch or hold that is farther from the others than this many of their standard deviations is a stray."""
LEAST_OUTLIER_MM = 1.0
LEAST_OFF_DEG, LEAST_AGREEING = 1.0, 5
"""A hold that is less than this from the others is no stray, and fewer holds than this do not outvote a stray."""


@dataclass(frozen=True, slots=True)
class TipFit:
    """Where the tip is, and how well that is known."""

    offset_mm: list[float]
    """Flange to tip, along the flange's axes."""
    pin_mm: list[float]
    """The point that was touched, in the base frame."""
    worst_mm: float
    """Largest distance of the tip from the point in a touch."""
    touch_mm: float
    """Standard deviation of one touch's distance from the point."""
    error_mm: float
    """Root mean square of the distance by which the offset may be wrong."""

    @property
    def limit_mm(self) -> float:
        """A touch that is farther from the point than this is a stray."""
        return max(LEAST_OUTLIER_MM, OUTLIER_SHARE * self.touch_mm)


def find_tip(flanges: Sequence[Pose]) -> TipFit:
    """Solve R_i t + p_i = c for the offset t and the point c by least squares (pivot calibration, e.g. Yaniv 2015).

    R_i and p_i are the poses of the flange. Raises `NotAccepted` for fewer than four touches, and for directions that
    are too alike.
    """
    if len(flanges) < LEAST_TOUCHES:
        raise NotAccepted(f"{len(flanges)} touches of the pin", f"are too few: {LEAST_TOUCHES} are needed.")
    turns = np.array([Rotation.from_quat(pose.quaternion).as_matrix() for pose in flanges])
    places = np.array([pose.position_mm for pose in flanges])
    equations = np.concatenate([np.concatenate([turn, -np.eye(3)], axis=1) for turn in turns])
    _, sizes, _ = np.linalg.svd(equations, full_matrices=False)
    condition = float(sizes[0] / max(sizes[-1], 1e-12))
    if condition > WORST_CONDITION:
        raise NotAccepted(
            f"the touches of the pin are too alike (condition number {condition:.0f}, limit {WORST_CONDITION:g}):",
            "lean the brush by 30 deg or more to all four sides, and do not turn the wrist along with it.",
        )
    solution = np.asarray(np.linalg.lstsq(equations, -places.ravel(), rcond=None)[0], np.float64)
    off = (equations @ solution + places.ravel()).reshape(-1, 3)
    seen_mm = math.sqrt(float((off**2).sum()) / (3 * len(flanges) - 6))
    spread = max(seen_mm, HAND_MM) * np.sqrt(np.diag(np.linalg.inv(equations.T @ equations)))
    return TipFit(
        offset_mm=solution[:3].tolist(),
        pin_mm=solution[3:].tolist(),
        worst_mm=float(np.linalg.norm(off, axis=1).max()),
        touch_mm=math.sqrt(3.0) * seen_mm,
        error_mm=float(np.linalg.norm(spread[:3])),
    )


def stray_touch(flanges: Sequence[Pose]) -> tuple[int, float, float] | None:
    """Number of the touch that does not fit the others, its distance from their point and the limit of that, in mm.

    A touch that slipped, or was never made at the pin, spoils the residuals of all, so each is compared with a fit of
    the others alone. None if all fit, and for fewer than five touches.
    """
    stray, worst = None, 1.0
    for k in range(len(flanges)):
        try:
            fit = find_tip([pose for n, pose in enumerate(flanges) if n != k])
        except NotAccepted:
            continue
        off_mm = math.dist(tip_of(flanges[k], fit.offset_mm), fit.pin_mm)
        if off_mm / fit.limit_mm > worst:
            stray, worst = (k, off_mm, fit.limit_mm), off_mm / fit.limit_mm
    return stray


@dataclass(frozen=True, slots=True)
class AxisFit:
    """How the brush leans against the flange, from poses in which a person held it upright."""

    rotation_deg: tuple[float, float, float]
    """As `robot.tcp_rotation_deg`: about x, then y, then z of the flange."""
    sigma_deg: float
    """Standard error of the lean in each direction; infinite for a single hold."""
    holds: int
    """Number of holds that agree."""
    strays: dict[int, float]
    """Numbers of the holds that do not agree with them, which are not part of the fit, and how far each is off in
    deg."""

    @property
    def clear(self) -> bool:
        """Whether so many holds agree that it is the strays which were not upright, and not the others."""
        return self.holds >= max(LEAST_AGREEING, 2 * len(self.strays))


def find_axis(flanges: Sequence[Pose]) -> AxisFit:
    """The brush's direction in the flange's frame: the mean of where "down" was, without the holds that stray.

    A hold strays if it is far from the median of all, which a minority of bad holds hardly moves. At least one pose.
    """
    down = np.array([Rotation.from_quat(p.quaternion).inv().apply([0.0, 0.0, -1.0]) for p in flanges])
    middle = np.median(down, axis=0)
    typical_deg = float(np.sort(_angles_deg(down, middle))[(len(down) - 1) // 2])
    agree = _angles_deg(down, middle) <= max(LEAST_OFF_DEG, OUTLIER_SHARE * typical_deg)
    mean = np.asarray(down[agree].mean(axis=0), np.float64)
    count, off_deg = int(agree.sum()), _angles_deg(down, mean)
    squares = float((off_deg[agree] ** 2).sum())
    sigma_deg = math.sqrt(squares / (2.0 * (count - 1)) / count) if count > 1 else math.inf
    lean, _ = Rotation.align_vectors(mean[None], [[0.0, 0.0, 1.0]])
    rz, ry, rx = lean.as_euler("ZYX", degrees=True)
    strays = {int(number): float(off_deg[number]) for number in np.flatnonzero(~agree)}
    return AxisFit((float(rx), float(ry), float(rz)), sigma_deg, count, strays)


def _angles_deg(directions: Floats, toward: Floats) -> Floats:
    """(n,) angles between (n, 3) directions and one, of any lengths."""
    across = np.linalg.norm(np.cross(directions, toward), axis=1)
    return np.degrees(np.arctan2(across, directions @ toward))


MOST_TOUCHES = 24
GOOD_MM = 0.18
"""Root mean square error of the tip at which touching ends."""
WORST_MM = 0.35
"""Above this after the last touch, the tip is not accepted."""
LEAST_UPRIGHTS, UPRIGHTS, MOST_UPRIGHTS = 3, 12, 24
"""Times that the brush is held against a set square, each with another turn of the wrist. Twelve times, each accurate
to 0.15 deg, leave a standard error of 0.04 deg."""
WORST_DEG = 0.12
"""Standard error above which the direction counts as not measured. An upright brush bends along the heading only by the
few degrees of its set, so an error of 0.12 deg across the heading turns every mark by 5 deg, and it is judged bent."""
LEAST_TURN_DEG = 10.0
"""By less than this from hold to hold the wrist was not turned, and perhaps the arm was not even moved."""
SIDES = ("away from you", "to the right", "toward you", "to the left")


class TipStep(Step):
    """The offset from the flange to the tip of the brush, and its direction."""

    name = "tip"
    title = "Tip of the brush"
    minutes = 9
    observes = ("pin", "upright")

    async def carry_out(self, visit: Visit) -> None:
        """Have the pin touched until the tip is known well enough. Raises `NotAccepted`."""
        visit.say(
            "Fix a pin upright, within reach from all sides. Power the arm and switch the pendant to hand guiding.",
            "Touch the pin's point with the tip of the dry brush. Lean it to another side each time, and hold still.",
        )
        await self._pin(visit)
        visit.say(
            "Now the direction of the brush: hold the brush upright along a set square that stands on the table.",
            f"{UPRIGHTS} upright poses are needed; the goal is a standard error of {WORST_DEG:g} deg.",
        )
        await self._uprights(visit)

    async def _pin(self, visit: Visit) -> None:
        """Have the pin touched until the tip is known well enough. Raises `NotAccepted`."""
        for index in range(MOST_TOUCHES):
            if f"pin {index}" in visit.notebook.touches:
                continue
            if self._tip_error_mm(visit) <= GOOD_MM:
                return
            how = (
                f"Touch {index + 1}: bring the tip to the pin, the brush leaning by 30 deg or more "
                f"{SIDES[index % 4]}. Do not turn the wrist along with it."
            )
            await touch(visit, f"pin {index}", how, may_skip=True)
        if (error_mm := self._tip_error_mm(visit)) > WORST_MM:
            visit.forget("pin")
            raise NotAccepted(
                f"after {MOST_TOUCHES} touches the standard error of the tip is still {error_mm:.2f} mm.",
                "Fix pin and brush firmly, hold still while you press Enter, and touch the pin again.",
            )

    def _tip_error_mm(self, visit: Visit) -> float:
        """How well the tip is known, shown to the person; infinite if it is not. Forgets a touch that strays."""
        touches = visit.notebook.touched("pin")
        if len(touches) < LEAST_TOUCHES:
            return math.inf
        try:
            fit = find_tip(list(touches.values()))
        except NotAccepted as error:
            visit.say(str(error), tone="warning")
            return math.inf
        if (stray := stray_touch(list(touches.values()))) is not None:
            number, off_mm, limit_mm = stray
            name = list(touches)[number]
            off = f"{off_mm:.1f} mm from the common point of the other touches (limit: {limit_mm:.1f} mm)"
            visit.say(f"Touch {int(name) + 1} lies {off}: it is left out.", tone="warning")
            visit.forget(f"pin {name}")
            return math.inf
        x, y, z = fit.offset_mm
        reached = "✓" if fit.error_mm <= GOOD_MM else "·"
        visit.say(
            f"tip at ({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange; residuals up to {fit.worst_mm:.2f} mm "
            f"(limit: {fit.limit_mm:.1f} mm)",
            f"{reached} standard error after {len(touches)} touches: {fit.error_mm:.3f} mm (goal: {GOOD_MM:g} mm)",
        )
        return fit.error_mm

    async def _uprights(self, visit: Visit) -> None:
        """Have the brush held upright until its direction is known well enough. Raises `NotAccepted`."""
        while not self._direction_known(visit):
            free = (n for n in range(MOST_UPRIGHTS) if f"upright {n}" not in visit.notebook.touches)
            if (index := next(free, None)) is None:
                visit.forget("upright")
                raise NotAccepted(
                    f"after {MOST_UPRIGHTS} poses the direction of the brush is not known to {WORST_DEG:g} deg.",
                    "Hold the brush along a set square, not by eye; or skip this measurement.",
                )
            how = f"Pose {index + 1}: brush upright along the set square, wrist turned differently each time."
            if not await touch(visit, f"upright {index}", how, may_skip=True):
                if measured_axis(visit.notebook) is None:
                    visit.say("The direction of the brush is not measured.", tone="warning")
                return

    def _direction_known(self, visit: Visit) -> bool:
        """Judge each hold by itself and by the others, name those that were not upright, and forget them."""
        holds = visit.notebook.touched("upright")
        if not holds:
            return False
        names, flanges = list(holds), list(holds.values())
        axis, square = find_axis(flanges), brush_square(find_axis(flanges[-1:]).rotation_deg)
        wrong = {names[k]: f"is {off_deg:.1f} deg from the other poses" for k, off_deg in axis.strays.items()}
        sure = axis.clear
        if square.verdict == "contradicts":
            wrong, sure = {names[-1]: f"would make the brush lean {square.value} (plausible: {square.allowed})"}, True
        elif len(holds) > 1 and distance(flanges[-2], flanges[-1])[1] < LEAST_TURN_DEG:
            wrong, sure = {names[-1]: "equals the pose before it: turn the wrist in between"}, True
        if wrong:
            verdict = "It is left out and repeated." if sure else "The next poses will show which were not upright."
            visit.say(*(f"Pose {int(name) + 1} {why}" for name, why in wrong.items()), verdict, tone="warning")
            if sure:
                visit.forget(*(f"upright {name}" for name in wrong))
            return False
        known = axis.holds >= UPRIGHTS and axis.sigma_deg <= WORST_DEG
        if len(holds) >= LEAST_UPRIGHTS:
            to_come = max(UPRIGHTS - axis.holds, 0 if known else 1)
            error = f"{axis.sigma_deg:.2f} deg ({axis.holds} upright poses)"
            reached = f"{'✓' if known else '·'} standard error of the brush's axis: {error}"
            visit.say(f"{reached}; {to_come} more poses to come" if to_come else reached)
        return known

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """The offset, and how the brush leans against the flange."""
        touches = list(notebook.touched("pin").values())
        fit = find_tip(touches)
        how = f"the same pin touched from {len(touches)} sides by hand"
        offset = Taught(fit.offset_mm, how, fit.error_mm, f"residuals up to {fit.worst_mm:.2f} mm")
        if (axis := measured_axis(notebook)) is None:
            turn = Taught([0.0, 0.0, 0.0], "assumed to be square to the flange", known="not measured")
        else:
            how = f"held upright along a set square {axis.holds} times"
            turn = Taught(list(axis.rotation_deg), how, axis.sigma_deg)
        return {"robot.tcp_offset_mm": offset, "robot.tcp_rotation_deg": turn}


def measured_axis(notebook: Notebook) -> AxisFit | None:
    """The direction of the brush; None where it was not held upright often or well enough to know it."""
    holds = list(notebook.touched("upright").values())
    axis = find_axis(holds) if holds else None
    return axis if axis is not None and axis.holds >= LEAST_UPRIGHTS and axis.sigma_deg <= WORST_DEG else None
