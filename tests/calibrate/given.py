"""What several tests are given: a session of few photographs, a camera above the paper, a lens file, and records."""

from __future__ import annotations

import csv
import functools
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from brushloop.calibrate.board.lens import Lens, LensFile, unknown_lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.compare import KEYS, Tone
from brushloop.calibrate.loop import AGAIN, ANOTHER, SIMULATED, LoopRecord, statistics_of
from brushloop.calibrate.presses import Press, prepare_job, press_of
from brushloop.calibrate.scores import Scores
from brushloop.calibrate.session import Calibration
from brushloop.calibrate.stroke.preprocess import Measured
from brushloop.calibrate.writing import Figure, Plan, PlannedBy, as_points
from brushloop.calibrate.writing.compare import KEYS as WRITTEN_KEYS
from brushloop.calibrate.writing.compare import PAIRS, PLANNED, Character, Table3Row, WritingComparison, WrittenRecord
from brushloop.model.raster import coverage
from brushloop.model.strokes import StrokeModel
from brushloop.sessions.events import BoardResult, CaptureResult, Condition, StepResult
from brushloop.sessions.events import Press as Pressed
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import encode_png, image_message
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Header, Source, Stroke, Topic
from brushloop.sessions.store import SessionStore


def rows_of(table: Path) -> list[dict[str, str]]:
    """The rows of a CSV file, by their columns."""
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    """How much of two masks they have in common, 0 to 1."""
    return float((mask & truth).sum() / (mask | truth).sum())


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
        press = Pressed(stroke_id=stroke.stroke_id, condition=condition)
        take(number, image, CaptureResult(press=press, still=number), stroke.model_copy(update={"still": number}))
    session.close()
    session.release()
    return folder


def opened(name: str, path: Path, brush: str = "", calibration: Calibration | None = None) -> Any:
    """What a report needs of an open session, without a recording."""
    header = Header(session_id=name, source=Source.LOOPBACK, software="test", brush=brush)
    return SimpleNamespace(header=header, recording=SimpleNamespace(path=path), sha256="ab", calibration=calibration)


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


ANCHOR_MM, PATCH_MM = (60.0, 40.0), (30.0, 28.0, 40.0, 24.0)
"""Where a press touches the page of `drawn_press`, and the patch around it."""


def drawn_press(stroke: Stroke, model: StrokeModel, depth_mm: float, tilt_deg: float) -> Press:
    """A model's mark on a page of 100 x 80 mm at 10 px/mm, found and laid on the field as a press of this stroke."""
    axis_x = ANCHOR_MM[0] + depth_mm * math.tan(math.radians(tilt_deg))
    origin = (axis_x, 80.0 - ANCHOR_MM[1])
    mark = coverage(model.profile(depth_mm, tilt_deg), origin, size_px=1000, px_mm=0.1)[0][:800]
    page = np.rint(230.0 * (1.0 - 0.92 * mark)).astype(np.uint8)
    stroke = stroke.model_copy(update={"cell_mm": PATCH_MM, "anchor_mm": ANCHOR_MM})
    header = Header(session_id="grid", source=Source.LOOPBACK, software="test")
    return press_of(header, stroke, prepare_job((Capture(stroke, encode_png(page), stroke.stroke_id), CALIBRATION)))


def blank_press(stroke_id: str, depth_mm: float, tilt_deg: float, session: str = "grid") -> Press:
    """A press of which only the name and the condition matter."""
    stroke = Stroke(stroke_id=stroke_id, kind="press", still=0, depth_mm=depth_mm, tilt_deg=tilt_deg)
    images, coverage = np.zeros((len(KEYS), 128, 128), np.uint8), np.zeros((128, 128), np.float32)
    return Press(session, "", stroke, images, coverage, (0.0, 0.0), Measured(1.0, 1.0, 1.0, 1.0, 1.0), False)


def kept_lens(folder: Path, size_px: tuple[int, int], k1: float, off_px: float = 0.0) -> Path:
    """A lens file as `camera intrinsics` would write it: of a rig's camera, off in focus and centre by so much."""
    focal_px = size_px[0] + 2.0 * off_px
    centre = (0.5 * (size_px[0] - 1) + off_px, 0.5 * (size_px[1] - 1) - off_px)
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


# What `brushloop repress` and `brushloop write` leave behind, without a rig: small records of a few scores

LEVELS = {AGAIN: 0.94, ANOTHER: 0.95, SIMULATED: 0.9}


def pair_scores(step: float = 0.001) -> Scores:
    """Six presses of three conditions, each pressed again: .94 like its original, another press .95."""
    scores = Scores([blank_press(f"{k:03d}", 11.0 + k // 2, 0.0) for k in range(6)], tuple(LEVELS))
    levels = np.array(list(LEVELS.values())) + step * np.arange(6)[:, None]
    scores.values[:] = np.stack([levels, levels - 0.1], axis=-1)[:, :, None]
    return scores


def loop_record(original: str, original_sha256: str, source: Source = Source.LOOPBACK, **changes: Any) -> LoopRecord:
    """A sealed loop of that session; `changes` are made before it is sealed."""
    scores = pair_scores()
    record = LoopRecord(
        source=source,
        original=original,
        original_sha256=original_sha256,
        again=f"{original}-replay",
        again_sha256="0" * 64,
        model="CCD-BSM fitted",
        in_sample=True,
        mm_per_px=0.3,
        pairs=6,
        goal_points=1.0,
        stats=tuple(statistics_of(scores)),
        refused=(),
        software="brushloop test",
        command="brushloop repress compare",
    )
    return record.model_copy(update=changes).sealed()


def cross(dx: int = 0, width: int = 8) -> np.ndarray:
    """(128, 128) ink: two bars, moved to the right."""
    image = np.zeros((128, 128), np.float32)
    image[60 : 60 + width, 30 + dx : 100 + dx] = 1.0
    image[30:100, 62 + dx : 62 + dx + width] = 1.0
    return image


def plan_of(character: str = "字", reference: str = "a font") -> Plan:
    """A plan of one character, a cross that a press would draw with wider bars."""
    strokes = [np.array([[1.0, 2.0, 3.0, 4.0, -0.0001], [5.5, 6.25, 7.125, 8.0, 9.0]])]
    images = {"wanted": cross(), "simulated": cross(width=10)}
    figure = Figure(name=character, source=reference, commanded=as_points(strokes), **images)
    return Plan(model="CCD-BSM", planned_by=PlannedBy(), cell_mm=60.0, software="test", figures=(figure,))


def table_of(character: str = "字", reference: str = "a font") -> tuple[Table3Row, ...]:
    """Table 3 of one character, written twice: CSIM .8 and .9, where paper counts .99."""
    [figure] = plan_of(character, reference).figures
    written = Character(figure, {f"x-r{k}": dict.fromkeys(Tone, cross()) for k in range(2)})
    twice = np.array([[0.8, 0.7], [0.9, 0.8]])
    # Takes the place of what would be computed from the images.
    written.__dict__["scores"] = {
        (pair, key): twice[: 1 if pair == PLANNED else 2] for key, pair in itertools.product(WRITTEN_KEYS, PAIRS)
    }
    return WritingComparison(None, None, [written]).table_3


def written_record(source: Source = Source.LOOPBACK, **changes: Any) -> WrittenRecord:
    """A sealed record of one character; `changes` are made before it is sealed."""
    record = WrittenRecord(
        source=source,
        session="write-01",
        recording_sha256="1" * 64,
        brush="",
        model="CCD-BSM",
        cell_mm=70.0,
        table_3=table_of(),
        refused=(),
        figure_13_sha256="2" * 64,
        software="brushloop test",
        command="brushloop write compare",
    )
    return record.model_copy(update=changes).sealed()
