"""Sessions of a few photographs, collected as the engine collects them but without a rig."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.sessions.events import BoardResult, CaptureResult, Condition, Press, StepResult
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import encode_png, image_message
from brushloop.sessions.records import Header, Source, Stroke, Topic
from brushloop.sessions.store import SessionStore
from tests.sessions.conftest import closed, make, out, photos, run, store  # noqa: F401 - fixtures of the exports

T0_NS = 1_700_000_000_000_000_000
MINUTE_NS = 60_000_000_000
Gray = NDArray[np.uint8]


class Photographed(Protocol):
    def __call__(
        self,
        folder: Path,
        spec: BoardSpec,
        boards: Sequence[Gray],
        presses: Sequence[tuple[Stroke, Gray]] = (),
        *,
        optics: Lens | None = None,
        sheet_mm: tuple[float, float] | None = None,
    ) -> Path: ...


@pytest.fixture(scope="session")
def photographed() -> Photographed:
    """A closed session: the board seen at intervals of a minute, then these strokes."""
    return _photographed


def _photographed(
    folder: Path,
    spec: BoardSpec,
    boards: Sequence[Gray],
    presses: Sequence[tuple[Stroke, Gray]] = (),
    *,
    optics: Lens | None = None,
    sheet_mm: tuple[float, float] | None = None,
) -> Path:
    rig: dict[str, Any] = {
        "board": spec.model_dump(),
        "camera": {"optics": None if optics is None else optics.model_dump()},
    }
    if sheet_mm is not None:
        rig["paper"] = {"size_mm": sheet_mm}
    snapshots = {"rig.toml": "", "protocol.toml": "", "rig.effective.json": json.dumps(rig)}
    header = Header(session_id=folder.name, source=Source.LOOPBACK, software="brushloop test")
    session = SessionStore.create(folder, header, snapshots, functools.partial(next, itertools.count(T0_NS, 1_000_000)))
    for number, image in enumerate(boards):
        height_px, width_px = image.shape
        board = BoardResult(
            still=number, corners=54, mm_per_px=0.05, rms_px=0.1, size_px=(width_px, height_px), sheet_px=()
        )
        _take(session, number, [_still(T0_NS + number * MINUTE_NS, number, image)], board)
    for number, (stroke, image) in enumerate(presses, start=len(boards)):
        t_ns = T0_NS + number * MINUTE_NS
        marked = Outgoing(Topic.STROKE, t_ns, t_ns, number, stroke.model_copy(update={"still": number}))
        condition = Condition(depth_mm=stroke.depth_mm or 0.0, tilt_deg=stroke.tilt_deg or 0.0)
        captured = CaptureResult(press=Press(stroke_id=stroke.stroke_id, condition=condition), still=number)
        _take(session, number, [_still(t_ns, number, image), marked], captured)
    session.close()
    session.release()
    return folder


def _take(session: SessionStore, number: int, messages: list[Outgoing], result: StepResult) -> None:
    attempt = session.begin(f"{result.kind} {number}", result.kind)
    for message in messages:
        attempt.writer.write(message)
    session.done(attempt, result)


def _still(t_ns: int, number: int, image: Gray) -> Outgoing:
    return Outgoing(Topic.STILL, t_ns, t_ns, number, image_message(t_ns, encode_png(image)))
