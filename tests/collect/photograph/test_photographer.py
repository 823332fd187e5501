"""A photograph is fresh because the camera has shown the arm over the sheet, and then gone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from brushloop.collect.errors import ArmInPicture, CameraLate
from brushloop.collect.photograph.photographer import CameraDelay, Look
from brushloop.drivers.devices import Frame
from tests.collect.photograph.theatre import OUT_MM, OVER_MM, PERIOD_S, Theatre


def age_s(theatre: Theatre, frame: Frame, since_s: float) -> float:
    """How long after `since_s` the frame was exposed; negative for one from before."""
    return theatre.start_s + theatre.exposures_s[frame.stamp.seq] - since_s


def arm_is_in(theatre: Theatre, frame: Frame) -> bool:
    exposed_s = theatre.start_s + theatre.exposures_s[frame.stamp.seq]
    return theatre.way(exposed_s) * OVER_MM[0] > OUT_MM


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.4])
async def test_a_steady_delay_is_reported(delay_s: float):
    theatre = Theatre(lambda _t_s: delay_s)
    photographer = theatre.photographer()
    await photographer.photograph()
    assert photographer.delay is not None
    assert photographer.delay.delay_s == pytest.approx(delay_s, abs=PERIOD_S)


@pytest.mark.parametrize(
    ("name", "delay"),
    [
        ("steady", lambda _t_s: 0.2),
        ("jittering", lambda t_s: 0.1 + 0.15 * ((t_s * 7919.0) % 1.0)),
        ("growing", lambda t_s: min(0.05 + 0.1 * t_s, 0.5)),
    ],
)
async def test_no_photograph_shows_the_arm_or_the_sheet_of_before(name: str, delay: Callable[[float], float]):
    theatre = Theatre(delay)
    photographer = theatre.photographer(max_jitter_ms=1500)
    for _ in range(3):
        await theatre.go(1.0)
        theatre.ink += 1
        inked_s = theatre.clock.now_ns() / 1e9
        frame = await photographer.photograph()
        assert age_s(theatre, frame, inked_s) >= 0.0
        assert not arm_is_in(theatre, frame)


async def test_an_arm_that_is_parked_already_is_shown_once_more():
    """After a change of sheets nothing else distinguishes a new picture from one of the old sheet."""
    theatre = Theatre(lambda _t_s: 0.2)
    photographer = theatre.photographer()
    await photographer.photograph()
    changed_s = theatre.clock.now_ns() / 1e9
    assert age_s(theatre, await photographer.photograph(), changed_s) >= 0.0


async def test_a_camera_that_is_too_late_is_refused_with_the_figure_and_the_way_out():
    theatre = Theatre(lambda _t_s: 0.3)
    with pytest.raises(CameraLate, match=r"too long: (2[5-9]|3[0-5])\d ± .*max_delay_ms = 200.* cable"):
        await theatre.photographer(max_delay_ms=200).photograph()


async def test_a_camera_that_is_not_steady_is_refused():
    theatre = Theatre(lambda t_s: 0.02 if t_s % 0.6 < 0.3 else 0.32)
    with pytest.raises(CameraLate, match=r"not steady: .*max_jitter_ms = 50"):
        await theatre.photographer(max_jitter_ms=50).photograph()


async def test_a_camera_that_looks_elsewhere_is_refused():
    theatre = Theatre(lambda _t_s: 0.0)
    theatre.way = lambda t_s: 0.0  # type: ignore[method-assign]
    with pytest.raises(CameraLate, match=r"did not show .* that the arm went over the sheet"):
        await theatre.photographer(max_delay_ms=50).photograph()


async def test_a_delay_that_has_grown_past_its_limit_is_refused_later():
    theatre = Theatre(lambda _t_s: 0.05)
    photographer = theatre.photographer(max_delay_ms=300)
    await photographer.photograph()
    theatre.delay = lambda _t_s: 0.6
    with pytest.raises(CameraLate, match=r"too long: [4-9]"):
        await photographer.photograph()
    assert photographer.delay is None  # measured again once somebody has been there


async def test_a_hand_in_the_picture_is_named_and_gives_no_photograph():
    theatre = Theatre(lambda _t_s: 0.05)
    photographer = theatre.photographer(max_delay_ms=200)
    await photographer.photograph()
    theatre.intruder = True
    with pytest.raises(ArmInPicture, match="the arm, a hand or a shadow"):
        await photographer.photograph()
    theatre.intruder = False
    await photographer.photograph()


async def test_frames_that_waited_for_a_stalled_computer_are_not_taken_for_new():
    """All that was exposed in the meantime arrives at once when it goes on."""
    theatre = Theatre(lambda _t_s: 0.05)
    photographer = theatre.photographer()
    await photographer.photograph()
    stall_s = theatre.clock.now_ns() / 1e9 - theatre.start_s + 0.1
    theatre.delay = lambda t_s: max(0.05, stall_s + 0.6 - t_s) if t_s >= stall_s else 0.05
    for _ in range(3):
        await theatre.go(1.0)
        inked_s = theatre.clock.now_ns() / 1e9
        frame = await photographer.photograph()
        assert age_s(theatre, frame, inked_s) >= 0.0
        assert not arm_is_in(theatre, frame)


async def test_pictures_of_what_the_arm_did_before_are_not_taken_for_the_first_trip():
    theatre = Theatre(lambda _t_s: 0.4)
    for way in (1.0, 0.0, 1.0, 0.0):
        await theatre.go(way)
    photographer = theatre.photographer()
    await photographer.photograph()
    assert photographer.delay is not None
    assert photographer.delay.delay_s == pytest.approx(0.4, abs=PERIOD_S)


async def test_a_delay_that_was_measured_wrongly_is_measured_again():
    theatre = Theatre(lambda _t_s: 0.4)
    photographer = theatre.photographer()
    await photographer.photograph()
    photographer.delay = CameraDelay((Look(0.02, 0.01), Look(0.03, 0.01)))
    inked_s = theatre.clock.now_ns() / 1e9
    assert age_s(theatre, await photographer.photograph(), inked_s) >= 0.0
    assert photographer.delay is None
    await photographer.photograph()
    assert photographer.delay is not None
    assert photographer.delay.delay_s == pytest.approx(0.4, abs=PERIOD_S)


def stalling(seed: int, share: float) -> Callable[[float], float]:
    """A delay of 0.3 s, which stalls of a busy computer prolong for a while, by 0.2 s on average."""
    rng = np.random.default_rng(seed)
    extra_s = rng.exponential(0.2, 4000) * (rng.random(4000) < share)
    return lambda t_s: 0.3 + float(extra_s[int(t_s / 0.5)])


async def test_beside_a_busy_computer_an_exact_delay_is_right_or_refused():
    found: list[float] = []
    for seed in range(6):
        photographer = Theatre(stalling(seed, 0.6)).photographer(
            max_jitter_ms=2000, max_delay_ms=3000, exact_delay=True
        )
        try:
            await photographer.photograph()
        except CameraLate:
            continue
        assert photographer.delay is not None
        found.append(photographer.delay.delay_s)
    assert all(abs(delay_s - 0.3) <= 0.2 * 0.3 for delay_s in found), found
    assert len(found) < 6


async def test_a_few_stalls_do_not_keep_an_exact_delay_from_being_measured():
    photographer = Theatre(stalling(3, 0.1)).photographer(max_jitter_ms=2000, max_delay_ms=3000, exact_delay=True)
    await photographer.photograph()
    assert photographer.delay is not None
    assert photographer.delay.delay_s == pytest.approx(0.3, rel=0.1)
