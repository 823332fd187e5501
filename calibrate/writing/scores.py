"""Written characters compared: with the plan's simulated image, the reference, and their other writings (Table 3)."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import cv2
import numpy as np

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare.place import (
    ROBOT_WRITING,
    SIZE_PX,
    TABLE_3,
    Alignment,
    Image,
    Polarity,
    Tone,
    similarity,
    to_tone,
)
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import read_gray
from brushloop.calibrate.presses import prepare_cell
from brushloop.calibrate.report import Sealed, load_sealed
from brushloop.calibrate.session import Calibration, open_session
from brushloop.calibrate.stats import Summary, others_of, summarise
from brushloop.calibrate.writing.record import FigureRecord, PlanRecord, Round, as_points
from brushloop.model.characters.plan import Phase, phase_map
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Source, Topic
from brushloop.sessions.terminal import Progress, counted, unseen

FILE, PICTURE = "written.json", "figure-13.png"
FORMAT = "brushloop-written-2"
MAX_BYTES = 8 * 1024 * 1024
Key = tuple[Alignment, Tone, Polarity]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone, Polarity))
HEADLINE: Key = (Alignment.MM, Tone.BINARY, Polarity.INK)
"""The comparison that decides which writing is better."""
Ink = dict[Tone, Image]
"""(128, 128) ink of a cell from 0 to 1 by tone: coverage of what counts as ink, and how dark it is."""
SIMULATED, REFERENCE = "captured, simulated", "captured, reference"
PLANNED, ANOTHER = "simulated, reference", "captured, another writing"
PAIRS = (SIMULATED, REFERENCE, PLANNED, ANOTHER)
"""The comparisons made."""
PAPER_ROWS = {SIMULATED: TABLE_3["ccd-bsmg"], REFERENCE: TABLE_3[ROBOT_WRITING]}
"""The paper's row shown with a comparison: our reading, see `TABLE_3`."""
NORMAL_SIDE_PX = 100


@dataclass(frozen=True, slots=True)
class Character:
    """One character: the image asked for, the model's image of the plan, and what was written."""

    name: str
    reference_name: str
    reference: Ink
    simulated: Ink
    captured: dict[str, Ink]
    """Ink by stroke id."""
    cut: tuple[str, ...] = ()
    """Writings whose ink reaches the edge of their cell."""

    def mean_ink(self) -> Image:
        """(128, 128) share of the writings that inked each pixel."""
        return np.asarray(np.mean([ink[Tone.BINARY] for ink in self.captured.values()], axis=0), np.float32)


@dataclass(frozen=True, slots=True)
class WrittenScore:
    """One comparison; `stroke_id` is empty if no writing is involved."""

    character: str
    stroke_id: str
    pair: str
    alignment: Alignment
    tone: Tone
    polarity: Polarity
    csim: float
    ssim: float


class Table3Row(Frozen):
    """One comparison over the writings of one character, in percent."""

    character: str
    reference: str
    """The font, or the user's picture."""
    pair: str
    """What was compared with what."""
    alignment: Alignment
    tone: Tone
    polarity: Polarity
    csim: Summary
    ssim: Summary


class WrittenRecord(Sealed):
    """Written characters as their `written.json` holds them: everything but the images and the single scores."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop write compare"

    format: str = FORMAT
    source: Source
    session: str
    recording_sha256: str
    brush: str
    """Name in the recording."""
    model: str
    cell_mm: float
    table_3: tuple[Table3Row, ...]
    refused: tuple[tuple[str, str], ...]
    """(stroke, why)."""
    figure_13_sha256: str
    """Of Figure 13 in the same folder."""
    software: str
    command: str

    @property
    def characters(self) -> tuple[str, ...]:
        """Their names, in the table's order."""
        return tuple(dict.fromkeys(row.character for row in self.table_3))


def read_written(path: Path) -> WrittenRecord:
    """Read `written.json`, or that in a report's folder. Raises `CalibrationError` if it is not one or was edited."""
    return load_sealed(path / FILE if path.is_dir() else path, WrittenRecord, MAX_BYTES)


def score_character(one: Character) -> Iterator[WrittenScore]:
    """Score every writing in every alignment, tone and polarity; another writing is the mean over the others."""
    inks = list(one.captured.values())
    for key in KEYS:
        yield _score(one, "", PLANNED, key, one.reference, [one.simulated])
        for k, (stroke_id, ink) in enumerate(one.captured.items()):
            yield _score(one, stroke_id, SIMULATED, key, ink, [one.simulated])
            yield _score(one, stroke_id, REFERENCE, key, one.reference, [ink])
            if others := [inks[j] for j in others_of(k, len(inks))]:
                yield _score(one, stroke_id, ANOTHER, key, ink, others)


def _score(one: Character, stroke_id: str, pair: str, key: Key, fixed: Ink, others: Sequence[Ink]) -> WrittenScore:
    csim, ssim = np.mean([compare_ink(fixed, other, key) for other in others], axis=0)
    return WrittenScore(one.name, stroke_id, pair, *key, float(csim), float(ssim))


def compare_ink(fixed: Ink, moving: Ink, key: Key) -> tuple[float, float]:
    """(CSIM, SSIM) of the ink of two cells. Raises ValueError for a blank one."""
    alignment, tone, polarity = key
    one, other = (to_tone(aligned(ink[tone], alignment), tone) for ink in (fixed, moving))
    return similarity(one, other, alignment, polarity)


def aligned(ink: Image, alignment: Alignment) -> Image:
    """(128, 128) as it is, or with the longer side of its ink scaled to 100 px and its bounding box in the middle."""
    if alignment is Alignment.MM:
        return ink
    rows, columns = np.flatnonzero((ink > 0.5).any(axis=1)), np.flatnonzero((ink > 0.5).any(axis=0))
    if not rows.size:
        raise ValueError("holds no ink")
    scale = NORMAL_SIDE_PX / (1 + max(rows[-1] - rows[0], columns[-1] - columns[0]))
    x, y = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    middle = 0.5 * SIZE_PX
    # cv2 puts pixel centres on integers, a pixel here covers [j, j + 1).
    move = np.array([[scale, 0.0, middle - 0.5 - scale * (x - 0.5)], [0.0, scale, middle - 0.5 - scale * (y - 0.5)]])
    return cast("Image", cv2.warpAffine(ink, move, (SIZE_PX, SIZE_PX), flags=cv2.INTER_LINEAR).clip(0.0, 1.0))


def table_3(scores: Iterable[WrittenScore], references: dict[str, str]) -> list[Table3Row]:
    """The rows, by character, then in the order of `KEYS` and `PAIRS`; `references` name each character's reference."""
    grouped: dict[tuple[str, Key, str], list[tuple[float, float]]] = {}
    for s in scores:
        grouped.setdefault((s.character, (s.alignment, s.tone, s.polarity), s.pair), []).append((s.csim, s.ssim))
    rows: list[Table3Row] = []
    for (character, reference), key, pair in itertools.product(references.items(), KEYS, PAIRS):
        percent = 100.0 * np.array(grouped.get((character, key, pair), [])).reshape(-1, 2)
        csim, ssim = summarise(percent[:, 0]), summarise(percent[:, 1])
        if csim is not None and ssim is not None:
            how = dict(zip(("alignment", "tone", "polarity"), key, strict=True))
            names = {"character": character, "reference": reference, "pair": pair}
            rows.append(Table3Row.model_validate(names | how | {"csim": csim, "ssim": ssim}))
    return rows


@dataclass(frozen=True, slots=True)
class WritingComparison:
    """Written characters, compared with their plan."""

    header: Header
    recording: Path
    recording_sha256: str
    calibration: Calibration
    plan: PlanRecord
    characters: list[Character]
    scores: list[WrittenScore]
    refused: tuple[tuple[str, str], ...] = ()
    """(stroke, why), never dropped in silence."""

    @property
    def table(self) -> list[Table3Row]:
        """Table 3."""
        return table_3(self.scores, {one.name: one.reference_name for one in self.characters})

    def ranked(self, one: Character) -> list[str]:
        """Stroke ids of a character by CSIM against the reference (`HEADLINE`), best first."""
        csim = {
            s.stroke_id: s.csim
            for s in self.scores
            if s.character == one.name and s.pair == REFERENCE and (s.alignment, s.tone, s.polarity) == HEADLINE
        }
        return sorted(csim, key=lambda stroke_id: -csim[stroke_id])


def compare_written(
    session: Path, plan: PlanRecord, references: dict[str, tuple[str, Image]], progress: Progress = unseen
) -> WritingComparison:
    """Compare a session with its plan. `references` (character -> name, image) replace those of the plan.

    Raises `CalibrationError` if the two do not belong together or nothing can be compared.
    """
    opened = open_session(session)
    recording, calibration = opened.recording, opened.calibration
    if calibration is None:
        raise CalibrationError(str(recording.path), "holds no characters that the arm wrote")
    _check_points(recording, plan)
    if unknown := sorted(set(references) - {figure.name for figure in plan.figures}):
        raise CalibrationError("--reference", f"{unknown[0]!r} is not in the plan")
    writings: dict[str, dict[str, Ink]] = {}
    cut, refused = set[str](), list[tuple[str, str]]()
    what = f"{recording.header.session_id}: found"
    for capture in counted(recording.captures(), what, recording.counts[Topic.STROKE], progress):
        stroke_id = capture.stroke.stroke_id
        try:
            prepared = prepare_cell(capture, calibration)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((stroke_id, error.what))
            continue
        ink = {Tone.BINARY: _small(prepared.mask.astype(np.float32)), Tone.GRAY: _small(prepared.soft)}
        writings.setdefault(stroke_id.rsplit("-r", 1)[0], {})[stroke_id] = ink
        cut |= {stroke_id} if prepared.cut else set()
    characters: list[Character] = []
    for figure in plan.figures:
        if captured := writings.get(figure.name):
            name, image = references.get(figure.name) or (figure.source, figure.wanted())
            images = as_ink(image), as_ink(figure.simulated())
            at_the_edge = tuple(stroke_id for stroke_id in captured if stroke_id in cut)
            characters.append(Character(figure.name, name, *images, captured, at_the_edge))
    if not characters:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(str(recording.path), f"no character can be compared{why}")
    counting = counted(characters, "characters compared", len(characters), progress)
    scores = [score for one in counting for score in score_character(one)]
    about_it = recording.header, recording.path, opened.sha256, calibration
    return WritingComparison(*about_it, plan, characters, scores, tuple(refused))


def _check_points(recording: Recording, plan: PlanRecord) -> None:
    """Check that the session's protocol drew the plan. Raises `CalibrationError` otherwise."""
    try:
        protocol: Any = json.loads(recording.header.protocol)
        points = {f["name"]: as_points([np.array(s["points"]) for s in f["strokes"]]) for f in protocol["figures"]}
        cell_mm = [float(side) for side in protocol["cell_mm"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(str(recording.path), "was not collected by a `write` protocol") from None
    if cell_mm != [plan.cell_mm, plan.cell_mm]:
        raise CalibrationError(str(recording.path), f"has cells of {cell_mm} mm, the plan {plan.cell_mm:g} mm")
    for name, commanded in points.items():
        figure = plan.figure(name)
        if figure is None or figure.commanded != commanded:
            raise CalibrationError(str(recording.path), f"{name!r} was not drawn from this plan")


def _small(image: Image) -> Image:
    return cast("Image", cv2.resize(image, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA))


def read_reference(path: Path) -> Image:
    """Read (128, 128) ink from a picture of a dark character on light, padded to square. Raises `CalibrationError`."""
    ink = 1.0 - read_gray(path).astype(np.float32) / 255.0
    if float(ink.mean()) > 0.5:
        raise CalibrationError(str(path), "is mostly dark: a reference is dark ink on light paper")
    height, width = ink.shape
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    return _small(np.pad(ink, ((top, side - height - top), (left, side - width - left))))


def as_ink(image: Image) -> Ink:
    """Make ink from an image that was not photographed: its darkness is its coverage."""
    return dict.fromkeys(Tone, image)


def round_of(figure: FigureRecord, character: Character, side_mm: float) -> Round:
    """What the writings of a figure show on average; phases for characters only."""
    wanted, writings = figure.wanted(), character.captured.values()
    csim = float(np.mean([compare_ink(as_ink(wanted), ink, HEADLINE)[0] for ink in writings]))
    lost: dict[str, float] = {}
    if figure.medians:
        where = phase_map(figure.paths, side_mm, len(wanted))
        wrong = np.mean([(wanted > 0.5) != (ink[Tone.BINARY] > 0.5) for ink in writings], axis=0)
        share = 100.0 * np.bincount(where.ravel(), wrong.ravel(), len(Phase)) / max(1, np.count_nonzero(wanted > 0.5))
        present = np.unique(where)
        lost = {str(phase): round(float(share[k]), 2) for k, phase in enumerate(Phase) if k in present}
    return Round(csim_percent=round(100.0 * csim, 3), lost_percent=lost)
