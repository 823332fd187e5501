"""Which strokes waited for their touch unlike the others of their session."""

from __future__ import annotations

import csv

import pytest

from brushloop.sessions.events import CaptureResult, StepKind
from brushloop.sessions.export import export
from brushloop.sessions.recording import unlike, waits_of


def test_a_wait_belongs_to_the_take_that_the_photograph_shows(make, store):
    for still, wait_s in ((3, 1.1), (6, 7.0), (9, None)):
        captured = CaptureResult(press=make.press("a", dip_to_touch_s=wait_s), still=still)
        store.done(store.begin(f"k{still}", StepKind.CAPTURE), captured)
    assert waits_of(store.state) == {3: 1.1, 6: 7.0}


def test_the_first_press_of_a_session_that_looked_after_its_dip_is_named():
    waits = {"first": 10.2, "second": 1.1, "third": 1.2, "fourth": 1.0}
    assert unlike(waits) == {"first": "touched the paper 10.2 s after its dip, the others after 1.1 s"}


@pytest.mark.parametrize(
    ("waits", "far"),
    [
        ([1.0, 1.1, 9.0], []),  # three cannot tell which of them is the odd one
        ([1.0, 1.1, 1.2, 3.1], []),  # less than two seconds
        ([1.0, 1.1, 1.2, 3.2], [3]),
        ([4.0, 8.0, 12.0, 16.0, 20.0], []),  # a session whose waits spread widely anyhow
        ([20.0, 20.1, 20.0, 5.0, 20.2], [3]),  # too early counts as well
        ([], []),
    ],
)
def test_far_is_two_seconds_and_three_median_deviations(waits: list[float], far: list[int]):
    assert list(unlike(dict(enumerate(waits)))) == far


def test_an_export_gives_the_wait_and_names_strokes_whose_wait_differs(make, tmp_path):
    fields = [{"dip_to_touch_s": wait} for wait in (1.0, 1.1, 10.0, 1.2)] + [{}]
    messages = [message for n, one in enumerate(fields) for message in (make.still(n), make.stroke(n, **one))]
    export(make.record(tmp_path / "a.mcap", *messages), tmp_path / "out", "png")
    with (tmp_path / "out" / "strokes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["dip_to_touch_s"] for row in rows] == ["1.0", "1.1", "10.0", "1.2", ""]
    assert [row["dip_to_touch_unlike"] for row in rows] == ["0.0", "0.0", "1.0", "0.0", ""]
