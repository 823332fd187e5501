"""What several tests are given: a session of few photographs, a camera straight above the paper, and a lens file."""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from brushloop.calibrate.board.lens import Lens, LensFile, unknown_lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.session import Calibration
from brushloop.sessions.events import BoardResult, CaptureResult, Condition, Press, StepResult
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import encode_png, image_message
from brushloop.sessions.records import Header, Source, Stroke, Topic
from brushloop.sessions.store import SessionStore

T0_NS, MINUTE_NS = 1_700_000_000_000_000_000, 60_000_000_000


def photographed(
    folder: Path,
    spec: BoardSpec,
    boards: Sequence[np.ndarray],
    presses: Sequence[tuple[Stroke, np.ndarray]] = (),
    *,
    optics: Lens | None = None,
    sheet_mm: tuple[float, float] | None = None,
) -> Path:
    """A closed session, collected as the engine does but without a rig: the board once a minute, then these strokes."""
    camera = {"optics": None if optics is None else optics.model_dump()}
    rig = json.dumps({"board": spec.model_dump(), "camera": camera, "paper": {"size_mm": sheet_mm}})
    snapshots = {"rig.toml": "", "protocol.toml": "", "rig.effective.json": rig}
    header = Header(session_id=folder.name, source=Source.LOOPBACK, software="brushloop test")
    session = SessionStore.create(folder, header, snapshots, functools.partial(next, itertools.count(T0_NS, 1_000_000)))

    def take(number: int, image: np.ndarray, result: StepResult, *marks: Stroke) -> None:
        t_ns, attempt = T0_NS + number * MINUTE_NS, session.begin(f"{result.kind} {number}", result.kind)
        still = image_message(t_ns, encode_png(image))
        for topic, message in ((Topic.STILL, still), *((Topic.STROKE, mark) for mark in marks)):
            attempt.writer.write(Outgoing(topic, t_ns, t_ns, number, message))
        session.done(attempt, result)

    for number, image in enumerate(boards):
        size_px = image.shape[::-1]
        board = BoardResult(still=number, corners=54, mm_per_px=0.05, rms_px=0.1, size_px=size_px, sheet_px=())
        take(number, image, board)
    for number, (stroke, image) in enumerate(presses, start=len(boards)):
        condition = Condition(depth_mm=stroke.depth_mm or 0.0, tilt_deg=stroke.tilt_deg or 0.0)
        press = Press(stroke_id=stroke.stroke_id, condition=condition)
        take(number, image, CaptureResult(press=press, still=number), stroke.model_copy(update={"still": number}))
    session.close()
    session.release()
    return folder


def flat_plane(size_px: tuple[int, int], mm_per_px: tuple[float, float]) -> Plane:
    """The plane seen straight from above by a camera of this (width, height); the origin is the lower left corner."""
    x_mm, y_mm = mm_per_px
    scale = math.sqrt(x_mm * y_mm)
    return Plane(
        # Pixel centres on integers: pixel (0, 0) is the middle of the first square.
        image_to_paper=(x_mm, 0.0, 0.5 * x_mm, 0.0, -y_mm, (size_px[1] - 0.5) * y_mm, 0.0, 0.0, 1.0),
        mm_per_px=scale,
        mm_per_px_low=scale,
        mm_per_px_high=scale,
        rms_px=0.0,
        corners=24,
        corners_dropped=0,
        lens=unknown_lens(size_px),
        middle_px=(0.0, 0.0),
    )


CALIBRATION = Calibration(
    **flat_plane((1000, 800), (0.1, 0.1)).model_dump(),
    session_id="test",
    source="loopback rig",
    recording_sha256="",
    software="",
    board=BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, origin_mm=(0.0, 0.0)),
    still_sha256="",
)


def kept_lens(
    folder: Path,
    size_px: tuple[int, int],
    k1: float,
    focal_px: float = 1024.0,
    centre_off_px: tuple[float, float] = (0, 0),
) -> Path:
    """A lens file as `camera intrinsics` would write it."""
    centre = ((side - 1) / 2 + off for side, off in zip(size_px, centre_off_px, strict=True))
    lens = Lens(size_px=size_px, matrix=(focal_px, focal_px, *centre), distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    return LensFile(
        software="brushloop test",
        photographs={"0.png": "ab" * 32},
        board="a board",
        lens=lens,
        ways=6,
        rms_px=0.2,
        residuals_px={"0.png": 0.2},
        dropped={},
        unusable={},
        slants_deg={"0.png": 20.0},
        guidance=(),
        warnings=(),
    ).save(folder)
