"""Takes photographs that are known to show the sheet as it is now, without the arm, and measures the camera's delay.

A camera's delay is not in its data sheet, and changes with the load of the computer. So the time at which a frame
arrives is not trusted: first the camera must show the arm over the sheet, then the arm parks, and only a frame after
one that shows the arm gone is a photograph of the sheet as it is now.

The delay is measured from trips over the sheet and back. It is not known where on its path the arm comes into the
picture, but it enters and leaves at the same point. The time for which it was seen, compared with its recorded
positions, gives that point and so the delay.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import dataclass, replace

import numpy as np

from brushloop.calibrate.board.lens import Floats
from brushloop.collect.errors import BadPicture, CameraLate
from brushloop.collect.photograph.frames import ARM_SHARE, Frames, Series, Thumbnail, View, watching
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import to_paper
from brushloop.drivers.devices import Frame, QueuedLine
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.host import alongside

GOOD_SHARE, GOOD_S = 0.1, 0.03
"""The delay is known well enough within a tenth of its value, or within 30 ms."""
MOST_GAP_S = 1.0
"""After a longer silence of camera or arm, the time of an event is unknown."""
SLACK_S = 0.05
"""How far a busy computer may shift the times of single poses and frames."""


@dataclass(frozen=True, slots=True)
class Look:
    """The delay measured on one trip over the sheet and back."""

    delay_s: float
    resolution_s: float
    """Uncertainty of the delay, as camera and arm report only once per period."""


@dataclass(frozen=True, slots=True)
class CameraDelay:
    """The delay measured on several trips."""

    looks: tuple[Look, ...]

    @property
    def delay_s(self) -> float:
        """Mean time from an event to the arrival of the first frame that shows it, without trips in which something
        stalled: those are farther from the median than the periods of camera and arm explain."""
        delays_s = np.array([look.delay_s for look in self.looks])
        off_s = np.abs(delays_s - np.median(delays_s))
        return float(delays_s[off_s <= max(2.0 * self._typical_s, GOOD_S, float(off_s.min()))].mean())

    @property
    def _typical_s(self) -> float:
        """Uncertainty of the delay of one trip."""
        return float(np.median([look.resolution_s for look in self.looks]))

    @property
    def spread_s(self) -> float:
        """Difference between the longest and the shortest delay."""
        delays_s = [look.delay_s for look in self.looks]
        return max(delays_s) - min(delays_s)

    @property
    def resolution_s(self) -> float:
        """Uncertainty of the mean delay."""
        return self._typical_s / len(self.looks) ** 0.5

    @property
    def bound_s(self) -> float:
        """The largest sum of a trip's delay and its uncertainty."""
        return max(look.delay_s + look.resolution_s for look in self.looks)

    @property
    def known(self) -> bool:
        """Whether the trips differ by no more than the camera's period explains, and suffice to average that out."""
        good_s = max(GOOD_SHARE * self.delay_s, GOOD_S)
        return self.spread_s <= max(2.0 * self._typical_s, good_s) and self.resolution_s <= good_s

    def __str__(self) -> str:
        delay_ms, resolution_ms, spread_ms = (1e3 * v for v in (self.delay_s, self.resolution_s, self.spread_s))
        trips = f"{len(self.looks)} measurements, which differ by {spread_ms:.0f} ms"
        return f"{delay_ms:.0f} ± {resolution_ms:.0f} ms (from {trips})"


def look(seen: Series, placed: Series) -> Look | None:
    """Return the delay of one trip; None if a silence, or a picture that does not fit the trip, leaves it unknown.

    `seen` is how much of the picture had changed in each frame, by its arrival; it begins and ends without the arm.
    `placed` is where the arm was: from 0, outside the picture, to 1, over the sheet, and back.
    """
    if len(seen) < 3 or len(placed) < 3:
        return None
    frames, places = np.array(seen, np.float64), np.array(placed, np.float64)
    arrival_s, changed, t_s, way = frames[:, 0], frames[:, 1], places[:, 0], places[:, 1]
    if max(np.diff(arrival_s).max(), np.diff(t_s).max()) > MOST_GAP_S:
        return None
    half = 0.5 * float(changed.max())
    inside = np.flatnonzero(changed >= half)
    first, last = int(inside[0]), int(inside[-1])
    if first == 0 or last == len(seen) - 1 or float(changed.max()) <= 0.0:
        return None
    entered_s, coarse_in = _crossing(arrival_s, changed, first, half)
    left_s, coarse_out = _crossing(arrival_s[::-1], changed[::-1], len(seen) - 1 - last, half)
    turn = int(np.argmax(way))
    points = np.linspace(0.02, 0.98, 97)
    there_s = np.interp(points, np.maximum.accumulate(way[: turn + 1]), t_s[: turn + 1])
    back_s = np.interp(points, np.maximum.accumulate(way[turn:][::-1]), t_s[turn:][::-1])
    # The farther out a point, the shorter the time beyond it: take the point at which that equals the time it was seen.
    misfit_s = np.abs((back_s - there_s) - (left_s - entered_s))
    at = int(np.argmin(misfit_s))
    if float(misfit_s[at]) > coarse_in + coarse_out + SLACK_S:
        return None  # the arm was seen for longer or shorter than it was there: the frames show another trip
    delay_s = 0.5 * float((entered_s - there_s[at]) + (left_s - back_s[at]))
    coarse_s = 0.5 * (coarse_in + coarse_out + _gap(t_s, there_s[at]) + _gap(t_s, back_s[at]))
    return Look(max(delay_s, 0.0), coarse_s)


def _crossing(arrival_s: Floats, changed: Floats, first: int, half: float) -> tuple[float, float]:
    """(when the change passed `half` between frame `first` - 1 and `first`, how uncertain that is), in s."""
    before, after = float(changed[first - 1]), float(changed[first])
    share = (half - before) / (after - before)
    gap_s = abs(float(arrival_s[first] - arrival_s[first - 1]))
    at_s = float(arrival_s[first - 1] + share * (arrival_s[first] - arrival_s[first - 1]))
    # Frames during the change narrow the time down; a jump from none to all leaves the whole gap uncertain.
    return at_s, 0.5 * gap_s * min(1.0, (after - before) / (2.0 * half))


def _gap(t_s: Floats, at_s: float) -> float:
    """Half the time between the two samples around `at_s`."""
    after = min(max(int(np.searchsorted(t_s, at_s)), 1), len(t_s) - 1)
    return 0.5 * float(t_s[after] - t_s[after - 1])


FEWEST_LOOKS, MOST_LOOKS = 2, 6
ATTEMPTS = 4
"""Most attempts at the measurement; another follows after one that a stall or an old picture made useless."""
PATIENCE_S = 1.5
"""Waiting time beyond the longest allowed delay: distinguishes a camera that is late from one that shows nothing."""
STAY_S = 0.15
"""How much longer each trip over the sheet is than the one before."""
GROWN_SHARE, GROWN_S = 0.2, 0.1
"""A delay that exceeds the known one by a fifth and by 0.1 s has to be measured again."""
POSE_PERIOD_S = 0.005
FASTER = "Use a cable instead of Wi-Fi, MJPEG instead of H.264, fewer frames or pixels, or no buffer in between."


class Photographer:
    """One camera over one sheet, for one run."""

    def __init__(
        self, rig: Rig, go: Callable[[QueuedLine], Awaitable[None]], over: QueuedLine, park: QueuedLine
    ) -> None:
        """`go` makes a move: `over` leads over the middle of the sheet, `park` out of the picture."""
        self._rig = rig
        self._config = rig.config.camera
        self._patience_s = self._config.max_delay_ms / 1e3 + PATIENCE_S
        self._go, self._over, self._park = go, over, park
        self._reference: Thumbnail | None = None
        """The sheet without the arm, as it was seen last."""
        self.delay: CameraDelay | None = None
        """Measured in this process; None until then."""

    def forget(self) -> None:
        """Forget delay and view, after somebody has been at the rig."""
        self._reference = self.delay = None

    async def photograph(self) -> Frame:
        """Park, and return the first frame that was exposed after the arm was gone.

        Raises `CameraLate`, `BadPicture`, or `DeviceError` if the camera shows nothing.
        """
        delay, reference = self.delay, self._reference
        seen_to_leave = delay is None or reference is None
        if delay is None or reference is None:
            delay, reference = self.delay, self._reference = await self._measured()
        async with watching(self._rig.camera, reference) as frames:
            if not seen_to_leave:
                await self._show_arm(frames)
            return await self._clear(frames, delay, self._rig.clock.now_ns())

    async def _show_arm(self, frames: Frames) -> None:
        """Have the arm over the sheet until the camera shows it there, then park. Raises `CameraLate`."""
        here, size_mm = await self._rig.robot.where(), self._rig.config.paper.size_mm
        at_mm = to_paper(self._rig.config.paper, here.x_mm, here.y_mm)
        if not all(0.0 <= at <= size for at, size in zip(at_mm, size_mm, strict=True)):
            await self._go(self._over)
        arrived_ns = self._rig.clock.now_ns()
        shown = await frames.first(lambda v: v.arm and v.frame.stamp.host_ns >= arrived_ns, within_s=self._patience_s)
        if shown is None:
            raise self._not_shown()
        await self._go(self._park)

    async def _clear(self, frames: Frames, delay: CameraDelay, parked_ns: int) -> Frame:
        """The first frame without the arm that was exposed after `parked_ns`. Raises `CameraLate`, `BadPicture`."""
        bound_ns = round(delay.bound_s * 1e9)
        clear = await frames.first(
            lambda v: not v.arm and v.still and v.frame.stamp.host_ns - bound_ns >= parked_ns,
            within_s=self._patience_s,
        )
        if clear is None:
            raise _in_picture(self._patience_s)
        self._check_drift(frames, delay, parked_ns / 1e9)
        self._reference = clear.small
        return replace(clear.frame, exposed_after_ns=parked_ns)

    def _check_drift(self, frames: Frames, delay: CameraDelay, parked_s: float) -> None:
        """Correct the delay if frames show the arm for longer after it parked. Raises `CameraLate` beyond the limit."""
        shown_s = (arrival_s for arrival_s, changed in frames.seen if changed >= ARM_SHARE)
        late_s = max(shown_s, default=parked_s) - parked_s
        if late_s > self._config.max_delay_ms / 1e3:
            self.forget()
            raise self._too_late(f"at least {1e3 * late_s:.0f} ms")
        if late_s > delay.bound_s + max(GROWN_SHARE * delay.bound_s, GROWN_S):
            self.delay = None  # it has grown, or was measured wrongly: the next photograph measures it again
        elif late_s > delay.bound_s:
            self.delay = CameraDelay((*delay.looks, Look(late_s, 0.0)))

    async def _measured(self) -> tuple[CameraDelay, Thumbnail]:
        """Send the arm over the sheet and back until the delay is known. Raises `CameraLate`.

        Returns the delay, and the view without the arm.
        """
        shown = False
        for attempt in range(ATTEMPTS):
            # The first view may have been old: after a failed attempt, wait until every old frame has passed.
            view = await self._view_without_arm(still_s=self._patience_s if attempt else 0.0)
            looks: list[Look] = []
            for number in range(MOST_LOOKS):
                # Trips of different lengths cannot be confused with each other.
                seen = await self._trip(view, stay_s=number * STAY_S)
                if seen is None:
                    break
                shown = True
                view, delay_of_trip = seen
                if delay_of_trip is not None:
                    looks.append(delay_of_trip)
                elif attempt == 0:
                    looks.clear()  # these pictures may all show what the arm did before
                    break
                if len(looks) >= FEWEST_LOOKS and CameraDelay(tuple(looks)).known:
                    break
            if len(looks) >= FEWEST_LOOKS:
                delay = CameraDelay(tuple(looks))
                if 1e3 * delay.delay_s > self._config.max_delay_ms:
                    raise self._too_late(str(delay))
                if 1e3 * delay.spread_s > self._config.max_jitter_ms:
                    raise self._uneven(str(delay))
                return delay, view
        raise self._uneven() if shown else self._not_shown()

    async def _trip(self, without_arm: Thumbnail, *, stay_s: float) -> tuple[Thumbnail, Look | None] | None:
        """Go over the sheet and back; return the view afterwards, and the delay (None if the camera was silent then).

        Returns None alone if the picture did not change when the arm came, or did not change back when it left.
        """
        within_s = self._patience_s
        async with watching(self._rig.camera, without_arm) as frames, self._placed() as placed:
            if await frames.first(lambda v: not v.arm, within_s=within_s) is None:
                return None
            await self._go(self._over)
            if await frames.first(lambda v: v.arm and v.still, within_s=within_s) is None:
                return None
            await asyncio.sleep(stay_s)
            await self._go(self._park)
            clear = await frames.first(lambda v: not v.arm and v.still, within_s=within_s)
        return None if clear is None else (clear.small, look(frames.seen, placed))

    async def _view_without_arm(self, *, still_s: float) -> Thumbnail:
        """A view with the arm parked, once nothing has moved in it for `still_s`. Raises `BadPicture`."""
        await self._go(self._park)
        moved_s = 0.0

        def settled(view: View) -> bool:
            nonlocal moved_s
            arrival_s = view.frame.stamp.host_ns / 1e9
            moved_s = moved_s if view.still else arrival_s
            return view.still and arrival_s - moved_s >= still_s

        async with watching(self._rig.camera, None) as frames:
            view = await frames.first(settled, within_s=3.0 * self._patience_s)
        if view is None:
            raise _in_picture(3.0 * self._patience_s)
        return view.small

    @contextlib.asynccontextmanager
    async def _placed(self) -> AsyncGenerator[Series]:
        """Within the block, note where the arm is on its way from park, 0, to the middle of the sheet, 1."""
        placed: Series = []
        park_mm, over_mm = self._park.target.position_mm, self._over.target.position_mm
        way_mm = [b - a for a, b in zip(park_mm, over_mm, strict=True)]
        length_mm = math.hypot(*way_mm)

        async def note() -> None:
            while True:
                with contextlib.suppress(DeviceError):
                    sample = self._rig.robot.latest()
                    gone_mm = [p - a for p, a in zip(sample.pose.position_mm, park_mm, strict=True)]
                    way = sum(g * w for g, w in zip(gone_mm, way_mm, strict=True)) / length_mm**2
                    t_s = sample.stamp.host_ns / 1e9
                    if not placed or t_s > placed[-1][0]:
                        placed.append((t_s, way))
                await asyncio.sleep(POSE_PERIOD_S)

        async with alongside(note(), "note the arm's path"):
            yield placed

    def _too_late(self, what: str) -> CameraLate:
        limit = f"camera.max_delay_ms = {self._config.max_delay_ms:g}"
        return CameraLate(f"the camera's delay is too long: {what}; {limit}. {FASTER}")

    def _uneven(self, what: str = "frames arrive too unevenly to measure the delay") -> CameraLate:
        limit = f"camera.max_jitter_ms = {self._config.max_jitter_ms:g}"
        return CameraLate(f"the camera's delay is not steady: {what}; {limit}. {FASTER}")

    def _not_shown(self) -> CameraLate:
        return CameraLate(
            f"within {self._patience_s:g} s, the camera did not show the arm going over the sheet and away again. "
            "It looks elsewhere, its picture is frozen, or its delay is far longer than camera.max_delay_ms = "
            f"{self._config.max_delay_ms:g}. Point it at the sheet; let nothing but the arm move in its view."
        )


def _in_picture(seconds: float) -> BadPicture:
    return BadPicture(
        f"{seconds:g} s after the arm parked, something still moves or stays in the picture (the arm, a hand or a "
        "shadow), or camera or sheet was moved. Clear the view. At motion.park_mm, the arm must be out of the picture."
    )
