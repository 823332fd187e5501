"""A photograph is fresh because the camera has shown the arm over the sheet, and then gone. How late a camera is."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.collect.errors import BadPicture, CameraLate
from brushloop.collect.photograph.frames import Series
from brushloop.collect.photograph.photographer import CameraDelay, Look, Photographer, look
from brushloop.collect.rig.config import CameraConfig, PaperConfig
from brushloop.drivers.devices import Frame, Pose, PoseSample, QueuedLine, Stamp
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.host import Clock
from tests.simulated_time import LoopClock

PERIOD_S, TRIP_S = 0.02, 0.06
PARK_MM, OVER_MM = (0.0, 0.0, 100.0), (200.0, 0.0, 100.0)
PAPER = PaperConfig(origin_mm=(100.0, -50.0), touch_z_mm=0.0, size_mm=(200.0, 100.0))
OUT_MM, IN_MM = 60.0, 120.0
"""From here to there on its way the arm comes into the picture."""


@dataclass
class Theatre:
    """Arm and camera as far as a photographer needs them; every delay is in seconds of the loop's time."""

    delay: Callable[[float], float]
    """By the time of exposure, in s since the start."""
    clock: Clock = field(default_factory=LoopClock)
    intruder: bool = False
    """A hand in the picture."""
    ink: int = 0
    """Strokes on the sheet."""

    def __post_init__(self) -> None:
        self.start_s = self._now_s()
        self._legs: list[tuple[float, float, float]] = [(self.start_s, 0.0, 0.0)]
        self._shown = 0
        self.exposures_s: dict[int, float] = {}
        """By the sequence of the frame, since the start: the truth."""

    def photographer(self, **limits: float) -> Photographer:
        camera = CameraConfig.model_validate({"kind": "opencv", "source": "0", **limits})
        config: Any = SimpleNamespace(camera=camera, paper=PAPER)
        over, park = (QueuedLine(brush_pose(*at_mm), 100.0) for at_mm in (OVER_MM, PARK_MM))
        rig: Any = SimpleNamespace(config=config, clock=self.clock, robot=self, camera=self)
        return Photographer(rig, lambda move: self.go(move.target.x_mm / OVER_MM[0]), over, park)

    def way(self, t_s: float) -> float:
        """Where the arm was: 0 parked, 1 over the sheet."""
        began_s, start, end = next(leg for leg in reversed(self._legs) if leg[0] <= t_s or leg is self._legs[0])
        return start + (end - start) * min(max((t_s - began_s) / TRIP_S, 0.0), 1.0)

    def latest(self) -> PoseSample:
        now_ns = self.clock.now_ns()
        x_mm = OVER_MM[0] * self.way(now_ns / 1e9)
        return PoseSample(Stamp(now_ns), brush_pose(x_mm, 0.0, 100.0))

    async def where(self) -> Pose:
        return self.latest().pose

    async def fresh(self, after: Stamp) -> Frame:
        while True:
            exposed_s = self.start_s + self._shown * PERIOD_S
            arrival_s = exposed_s + self.delay(exposed_s - self.start_s)
            if arrival_s > self._now_s():
                await asyncio.sleep(arrival_s - self._now_s())
                continue
            self._shown += 1
            if arrival_s * 1e9 >= after.host_ns:
                self.exposures_s[self._shown] = exposed_s - self.start_s
                stamp = Stamp(round(arrival_s * 1e9), None, self._shown)
                return Frame(stamp, stamp.host_ns, self._draw(exposed_s))

    async def go(self, way: float) -> None:
        now_s = self._now_s()
        self._legs.append((now_s, self.way(now_s), way))
        await asyncio.sleep(TRIP_S + 0.01)

    def _draw(self, t_s: float) -> np.ndarray:
        image = np.full((120, 160), 230, np.uint8)
        x_mm = OVER_MM[0] * self.way(t_s)
        if x_mm > OUT_MM:
            shown = min((x_mm - OUT_MM) / (IN_MM - OUT_MM), 1.0)
            cv2.circle(image, (80, round(120 + 30 - 90 * shown)), 30, (70,), -1)
        if self.intruder:
            cv2.rectangle(image, (10, 10), (50, 50), (40,), -1)
        for number in range(self.ink):
            image[5 + 12 * (number // 8) :][:2, 5 + 18 * (number % 8) :][:, :6] = 15
        return image

    def _now_s(self) -> float:
        return self.clock.now_ns() / 1e9


def age_s(theatre: Theatre, frame: Frame, since_s: float) -> float:
    """How long after `since_s` the frame was exposed; negative for one from before."""
    return theatre.start_s + theatre.exposures_s[frame.stamp.seq] - since_s


async def measured_s(photographer: Photographer) -> float:
    """The delay that it knows after a photograph."""
    await photographer.photograph()
    assert photographer.delay is not None
    return photographer.delay.delay_s


@pytest.mark.parametrize("before", [(), (1.0, 0.0, 1.0, 0.0)])
@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.4])
async def test_a_steady_delay_is_reported_whatever_the_arm_did_before(delay_s: float, before: tuple[float, ...]):
    theatre = Theatre(lambda _t_s: delay_s)
    for way in before:
        await theatre.go(way)
    assert await measured_s(theatre.photographer()) == pytest.approx(delay_s, abs=PERIOD_S)


@pytest.mark.parametrize("parked", [False, True])
@pytest.mark.parametrize(
    "delay",
    [
        pytest.param(lambda _t_s: 0.2, id="steady"),
        pytest.param(lambda t_s: 0.1 + 0.15 * ((t_s * 7919.0) % 1.0), id="jittering"),
        pytest.param(lambda t_s: min(0.05 + 0.1 * t_s, 0.5), id="growing"),
        pytest.param(lambda t_s: max(0.05, 0.6 - t_s % 1.7), id="stalling: frames wait, and arrive at once"),
    ],
)
async def test_no_photograph_shows_the_arm_or_the_sheet_of_before(delay: Callable[[float], float], parked: bool):
    """Nor where the arm is parked already: after a change of sheets, nothing else distinguishes a new picture."""
    theatre = Theatre(delay)
    photographer = theatre.photographer(max_jitter_ms=1500)
    for _ in range(3):
        if not parked:
            await theatre.go(1.0)
        theatre.ink += 1
        inked_s = theatre.clock.now_ns() / 1e9
        frame = await photographer.photograph()
        after_s = age_s(theatre, frame, inked_s)
        assert after_s >= 0.0
        assert theatre.way(inked_s + after_s) * OVER_MM[0] <= OUT_MM, "the arm is in the picture"


@pytest.mark.parametrize(
    ("delay", "way", "limits", "message"),
    [
        (lambda _: 0.3, None, {"max_delay_ms": 200}, r"too long: (2[5-9]|3[0-5])\d ± .*max_delay_ms = 200.* cable"),
        (lambda t_s: 0.02 if t_s % 0.6 < 0.3 else 0.32, None, {"max_jitter_ms": 50}, r"not steady: .*jitter_ms = 50"),
        (lambda _: 0.0, lambda _: 0.0, {"max_delay_ms": 50}, r"did not show the arm going over the sheet"),
    ],
    ids=["too late", "not steady", "looks elsewhere"],
)
async def test_a_camera_that_cannot_be_trusted_is_refused_with_the_figure_and_the_way_out(
    monkeypatch: pytest.MonkeyPatch, delay: Any, way: Any, limits: dict[str, float], message: str
) -> None:
    theatre = Theatre(delay)
    if way is not None:
        monkeypatch.setattr(theatre, "way", way)
    with pytest.raises(CameraLate, match=message):
        await theatre.photographer(**limits).photograph()


async def test_a_delay_that_has_grown_past_its_limit_or_a_hand_in_the_picture_gives_no_photograph_until_it_is_mended():
    theatre = Theatre(lambda _t_s: 0.05)
    photographer = theatre.photographer(max_delay_ms=300)
    await photographer.photograph()
    theatre.delay = lambda _t_s: 0.6
    with pytest.raises(CameraLate, match=r"too long: at least [4-9]"):
        await photographer.photograph()
    assert photographer.delay is None  # measured again once somebody has been there
    theatre.delay = lambda _t_s: 0.05
    await photographer.photograph()
    theatre.intruder = True
    with pytest.raises(BadPicture, match="the arm, a hand or a shadow"):
        await photographer.photograph()
    theatre.intruder = False
    await photographer.photograph()


async def test_a_delay_that_was_measured_wrongly_is_measured_again():
    theatre = Theatre(lambda _t_s: 0.4)
    photographer = theatre.photographer()
    await photographer.photograph()
    photographer.delay = CameraDelay((Look(0.02, 0.01), Look(0.03, 0.01)))
    inked_s = theatre.clock.now_ns() / 1e9
    assert age_s(theatre, await photographer.photograph(), inked_s) >= 0.0
    assert photographer.delay is None
    assert await measured_s(photographer) == pytest.approx(0.4, abs=PERIOD_S)


# The delay by one trip, from when the camera saw the arm and when it was where

ENTERS = 0.4
"""The share of its way at which the arm comes into the picture; nothing below knows it."""


def way(t_s: float, trip_s: float, stay_s: float) -> float:
    """Parked for a second, there, a stay, and back."""
    begins_s, ends_s = 1.0, 1.0 + trip_s + stay_s
    return min(max((t_s - begins_s) / trip_s, 0.0), 1.0) - min(max((t_s - ends_s) / trip_s, 0.0), 1.0)


def trip(delay_s: float, *, period_s: float, phase: float, trip_s: float, stay_s: float) -> tuple[Series, Series]:
    end_s = 2.0 + 2.0 * trip_s + stay_s
    exposed = np.arange(phase * period_s, end_s, period_s)
    trips = [way(t, trip_s, stay_s) for t in exposed]
    seen = [
        (float(t) + delay_s, 0.15 * min(max((w - ENTERS) / 0.3, 0.0), 1.0)) for t, w in zip(exposed, trips, strict=True)
    ]
    return seen, [(float(t), way(float(t), trip_s, stay_s)) for t in np.arange(0.0, end_s, 0.01)]


@given(
    delay_s=st.floats(0.0, 2.5),
    period_s=st.floats(0.02, 0.125),
    phase=st.floats(0.0, 1.0),
    trip_s=st.floats(0.05, 2.0),
    stay_s=st.floats(0.3, 1.0),
)
def test_the_delay_is_found_within_its_resolution(
    delay_s: float, period_s: float, phase: float, trip_s: float, stay_s: float
):
    found = look(*trip(delay_s, period_s=period_s, phase=phase, trip_s=trip_s, stay_s=stay_s))
    assert found is not None
    assert found.resolution_s <= period_s
    assert found.delay_s == pytest.approx(delay_s, abs=found.resolution_s + 0.03)


def test_a_slow_arm_is_seen_on_its_way_and_gives_the_delay_far_better_than_the_frames_come():
    seen, placed = trip(0.1, period_s=0.125, phase=0.3, trip_s=2.0, stay_s=0.5)
    found = look(seen, placed)
    assert found is not None
    assert found.delay_s == pytest.approx(0.1, abs=0.02)
    assert found.resolution_s < 0.03


@pytest.mark.parametrize(
    ("stay_s", "seen_s", "shown"),
    [
        (0.3, 0.9, lambda frame: frame),
        (0.3, 0.3, lambda frame: (frame[0], 0.0)),
        (3.0, 3.0, lambda frame: None if 1.5 < frame[0] < 3.0 else frame),
    ],
    ids=["another trip was seen for longer", "the picture does not change", "a long silence"],
)
def test_pictures_that_do_not_show_the_trip_give_no_delay(
    stay_s: float, seen_s: float, shown: Callable[[tuple[float, float]], tuple[float, float] | None]
) -> None:
    seen, placed = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=stay_s)
    assert look(seen, placed) is not None
    seen, _ = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=seen_s)
    assert look([frame for frame in map(shown, seen) if frame is not None], placed) is None


def test_several_looks_are_reported_with_their_spread_and_a_stall_does_not_make_the_camera_later() -> None:
    delay = CameraDelay((Look(0.20, 0.02), Look(0.26, 0.04)))
    assert (delay.delay_s, delay.spread_s, delay.bound_s) == pytest.approx((0.23, 0.06, 0.30))
    assert str(delay) == "230 ± 21 ms (from 2 measurements, which differ by 60 ms)"
    delay = CameraDelay((Look(0.41, 0.03), Look(0.65, 0.03), Look(0.42, 0.03), Look(0.40, 0.03)))
    # The stall still counts as unsteady, and a photograph waits for the longest.
    assert (delay.delay_s, delay.spread_s, delay.bound_s) == pytest.approx((0.41, 0.25, 0.68))
    assert CameraDelay((Look(0.40, 0.03), Look(0.65, 0.03))).delay_s == pytest.approx(0.525), "either may have stalled"
