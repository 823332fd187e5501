"""`brushloop repress compare`: a session compared with the one that pressed its strokes again, pair by pair.

A repetition is compared with its original as two presses of one condition are: the third row of Table 1.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.commands import CompareLoopRequest
from brushloop.calibrate.compare import KEYS, MM_PER_PX, ROBOT_WRITING, STRICT, TABLE_1, Key, Pixels, simulated
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.presses import Press, Refused, read_presses, too_thin, uncommanded
from brushloop.calibrate.report import Point, Sealed, about, render, source_point, write_files
from brushloop.calibrate.scores import MEASURES, Scores, Stat, scores_csv, similarities, statistics
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stats import Interval, Summary, is_near
from brushloop.model.ccdbsm import DomainError
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.model.strokes import StrokeModel
from brushloop.sessions.disk import check_writable
from brushloop.sessions.records import Condition, Source
from brushloop.sessions.terminal import Progress, unseen

PAGE, TABLE = "loop.html", "loop.csv"
AGAIN, ANOTHER, SIMULATED = "re-pressed", "another press", "recovered, simulated"
"""What is compared with an original: its repetition, other originals of its condition, the model's image of it."""
GOAL_POINTS = 1.0
"""Points by which re-pressed strokes may score below the originals' own repeatability."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A stroke and its repetition. Depth and tilt of `original` are as commanded, those of `again` as recovered."""

    original: Press
    again: Press
    simulated: Pixels
    """(len(KEYS), 128, 128): the model's press at the recovered depth and tilt."""


class LoopRecord(Sealed):
    """A closed loop as stored in `loop.json`: everything but the images and the individual scores."""

    FILE: ClassVar[str] = "loop.json"
    FORMAT: ClassVar[str] = "brushloop-loop-4"
    MADE_BY: ClassVar[str] = "brushloop repress compare"

    source: Source
    """Kind of ink of the session that pressed again."""
    original: str
    original_sha256: str
    again: str
    again_sha256: str
    """Session ids, and the SHA-256 of each recording."""
    model: str
    """The model that recovered, or is assumed to have recovered, depth and tilt, and drew the generated images."""
    in_sample: bool
    """Whether that model was fitted to the original presses themselves."""
    mm_per_px: float
    """Scale of the millimetre field."""
    pairs: int
    goal_points: float
    stats: tuple[Stat, ...]
    """The ceiling of the re-pressed strokes is how alike other presses of each condition are."""
    refused: tuple[Refused, ...]
    software: str
    command: str

    def rows(self, key: Key) -> list[Stat]:
        """The rows of the table in one alignment and tone."""
        return [row for row in self.stats if (row.alignment, row.tone) == key]

    @property
    def lost(self) -> list[tuple[float, Interval | None, bool | None, str, Stat]]:
        """Points below another press, their 95 % interval, whether they are within the goal, the measure, and its row.

        Over the originals that have both; empty where no condition was pressed twice. The third is None if not certain.
        """
        lost: list[tuple[float, Interval | None, bool | None, str, Stat]] = []
        for row, measure in itertools.product(self.stats, MEASURES):
            of: Summary = getattr(row, measure)
            if row.model == AGAIN and of.below_ceiling is not None:
                below, interval = of.below_ceiling, of.below_interval
                near = is_near(below, interval, self.goal_points) if interval else None
                lost.append((below, interval, near, measure, row))
        return lost

    @property
    def answer(self) -> Point:
        """The result in one sentence."""
        if not self.lost:
            return Point(None, f"{self.again}: no condition was pressed twice, so the repeatability is unknown.")
        points, interval, _, measure, row = max(self.lost, key=lambda lost: lost[0])
        good = min((near for _, _, near, *_ in self.lost), key=(False, None, True).index)
        span = "" if interval is None else "; 95 % interval: {:.1f} to {:.1f}".format(*interval)
        sure = "" if good is not None else ", which is not certain yet: press more of them again"
        return Point(
            good,
            f"Recovered presses, pressed again ({self.again}), score {max(0.0, points):.1f} points of "
            f"{measure.upper()} lower than other presses of the same depth and tilt, in the worst of all comparisons "
            f"({row.alignment}, {row.tone}{span}). The goal is at most {self.goal_points:g} point{sure}.",
        )


def compare(request: CompareLoopRequest, progress: Progress = unseen) -> Written:
    """Compare presses with those that repeat them, pair by pair, and write the report.

    Raises `CalibrationError` where the two sessions do not belong together, and OSError.
    """
    check_writable(request.out)
    first, second = (open_session(path, kind="press") for path in (request.original, request.again))
    where, source = str(second.recording.path), second.header.source
    if (first.header.source == Source.LOOPBACK) != (source == Source.LOOPBACK):
        raise CalibrationError(where, f"has the source {source}, but the original has {first.header.source}")
    try:
        repeated: Any = json.loads(second.header.protocol)["of"]
    except (ValueError, KeyError, TypeError, RecursionError):
        repeated = None
    if repeated != first.header.session_id:
        what = "" if repeated is None else f", but {repeated}"
        raise CalibrationError(where, f"does not repeat {first.header.session_id}{what}")
    model, fit = BrushFit.model_of(request.fit, first)
    refused: list[Refused] = []
    originals, repetitions = (
        list(read_presses(session, refused, uncommanded, too_thin, progress=progress)) for session in (first, second)
    )
    pairs = pair_up(originals, repetitions, model, refused)
    if not pairs:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(where, f"no pair of presses can be compared{why}")
    scores = score_pairs(pairs, originals)
    record = LoopRecord(
        source=source,
        original=first.header.session_id,
        original_sha256=first.sha256,
        again=second.header.session_id,
        again_sha256=second.sha256,
        model=model.label,
        in_sample=fit is not None and fit.recording_sha256 == first.sha256,
        mm_per_px=MM_PER_PX,
        pairs=len(pairs),
        goal_points=GOAL_POINTS,
        stats=tuple(statistics_of(scores)),
        refused=tuple(refused),
        software=made_by(),
        command=request.command,
    ).sealed()
    page = write_loop(record, (first, second), pairs, scores, request.out)
    said = [f"{record.pairs} presses repeated, {len(refused)} not compared ({source})"]
    for key in KEYS:
        parts = "; ".join(f"{row.model} {row.csim.avg:.2f} / {row.ssim.avg:.2f}" for row in record.rows(key))
        said.append(f"{key[0]}, {key[1]}, CSIM / SSIM: {parts}")
    return Written(page, (*said, record.answer.text, f"Report:  {page}"), refused)


def pair_up(
    originals: Sequence[Press], repetitions: Iterable[Press], model: StrokeModel, refused: list[Refused]
) -> list[Pair]:
    """Pair presses by `again_of`. Those without a partner, originals included, go to `refused`."""
    by_name = {press.stroke.stroke_id: press for press in originals}
    pairs: list[Pair] = []
    for press in repetitions:
        name, original = press.stroke.stroke_id, by_name.get(press.stroke.again_of or "")
        if original is None:
            of = press.stroke.again_of or "an unnamed stroke"
            refused.append((name, f"repeats {of}, whose original is missing or cannot be used"))
            continue
        try:
            images = simulated(model, press.condition.depth_mm, press.condition.tilt_deg)
        except DomainError as error:
            refused.append((name, f"the model does not predict this press: {error}"))
        else:
            pairs.append(Pair(original, press, images))
    repeated = {pair.original.stroke.stroke_id for pair in pairs}
    refused.extend((name, "was not pressed again") for name in by_name if name not in repeated)
    return pairs


def score_pairs(pairs: Sequence[Pair], originals: Iterable[Press]) -> Scores:
    """Score repetition, other presses of the condition and simulation against the original of each pair."""
    alike: dict[Condition, list[Press]] = {}
    for press in originals:
        alike.setdefault(press.condition, []).append(press)
    labelled = [replace(pair.original, source=pair.again.source) for pair in pairs]
    scores = Scores(labelled, (AGAIN, ANOTHER, SIMULATED))
    for pair, values in zip(pairs, scores.values, strict=True):
        others = [press.images for press in alike[pair.original.condition] if press is not pair.original]
        values[:] = similarities(pair.original.images, ([pair.again.images], others, [pair.simulated]))
    return scores


def statistics_of(scores: Scores) -> Iterator[Stat]:
    """The statistics of each comparison, in percent; those of re-pressed strokes say how far below another press."""
    another = 100.0 * scores.of(ANOTHER)
    for compared in scores.models:
        percent = 100.0 * scores.of(compared)
        yield from statistics(compared, percent, scores.group_of, ceiling=another if compared == AGAIN else None)


def write_loop(
    record: LoopRecord, sessions: tuple[OpenSession, OpenSession], pairs: Sequence[Pair], scores: Scores, folder: Path
) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError.

    The sessions are the original and the one that pressed it again.
    """
    header = sessions[0].header
    percent = 100.0 * scores.of_key(AGAIN, STRICT)
    worst_first: list[int] = percent[:, 0].argsort(kind="stable").tolist()
    page = render(
        "loop.html.j2",
        **about(header.model_copy(update={"source": record.source})),
        header=header,
        record=record,
        trust=list(_trust(record)),
        beside=(TABLE, record.FILE),
        tables=[(key, record.rows(key)) for key in KEYS],
        paper=TABLE_1[ROBOT_WRITING],
        rows=[(pairs[k], percent[k]) for k in worst_first],
        ssim_settings=SSIM_SETTINGS,
        sessions=sessions,
    )
    write_files(folder, {TABLE: scores_csv(scores), record.FILE: record.to_json(), PAGE: page})
    return folder / PAGE


def _trust(record: LoopRecord) -> Iterator[Point]:
    yield source_point(record.source)
    if record.in_sample:
        words = "The model that recovered depth and tilt was fitted to these same presses with their commanded values"
        yield Point(None, f"{words}. Recovered values near these prove nothing about the model: compare the marks.")
    if record.refused:
        yield Point(False, f"{len(record.refused)} strokes are not compared; each is named below, with the reason.")
