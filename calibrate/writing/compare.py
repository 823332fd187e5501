"""`brushloop write compare`: written characters beside the plan's simulated image, the reference, and each other.

Table 3 and Figure 13 of the paper, as one self-contained page, CSV and JSON.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from brushloop.calibrate import compare as images
from brushloop.calibrate.artefact import Frozen, made_by
from brushloop.calibrate.commands import CompareWrittenRequest
from brushloop.calibrate.compare import SIZE_PX, Alignment, Image, Polarity, Tone
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import Written
from brushloop.calibrate.presses import Refused, prepare_patch
from brushloop.calibrate.report import Sealed, about, data_uri, overlay, picture_grid, render, save_picture, write_files
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stats import Floats, Summary, pair_means, summarise
from brushloop.calibrate.stroke.preprocess import Prepared
from brushloop.calibrate.writing import Figure, Plan, Round, as_points, code_points, load_plan, recorded_figures
from brushloop.model.characters.plan import Phase, phase_map
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.disk import check_writable, csv_text
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.records import Source
from brushloop.sessions.terminal import Progress, counted, unseen

PICTURE, PAGE, TABLE = "figure-13.png", "written.html", "written.csv"
Key = tuple[Alignment, Tone, Polarity]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone, Polarity))
HEADLINE: Key = (Alignment.MM, Tone.BINARY, Polarity.INK)
"""The comparison that decides which writing is better."""
Ink = dict[Tone, Image]
"""(128, 128) ink of a patch from 0 to 1 by tone: coverage of what counts as ink, and how dark it is."""
SIMULATED, REFERENCE = "captured, simulated", "captured, reference"
PLANNED, ANOTHER = "simulated, reference", "captured, another writing"
PAIRS = (SIMULATED, REFERENCE, PLANNED, ANOTHER)
"""The comparisons made."""
PAPER_ROWS = {SIMULATED: images.TABLE_3["ccd-bsmg"], REFERENCE: images.TABLE_3[images.ROBOT_WRITING]}
"""The paper's row shown with a comparison: our reading, see `TABLE_3`."""


@dataclass(frozen=True)
class Character:
    """One character: its figure of the plan, whose wanted image is the reference, and what was written."""

    figure: Figure
    captured: dict[str, Ink]
    """Ink by stroke id."""

    def mean_ink(self) -> Image:
        """(128, 128) share of the writings that inked each pixel."""
        return np.asarray(np.mean([ink[Tone.BINARY] for ink in self.captured.values()], axis=0), np.float32)

    @functools.cached_property
    def scores(self) -> dict[tuple[str, Key], Floats]:
        """(n, 2) CSIM and SSIM, from 0 to 1, of every writing in each of `PAIRS` and `KEYS`.

        `PLANNED` has one row, since no writing is involved; a writing alone has NaN for another one.
        """
        inks = list(self.captured.values())
        # An image that was not photographed is as dark as its coverage.
        reference, simulated = (dict.fromkeys(Tone, image) for image in (self.figure.wanted, self.figure.simulated))
        scores: dict[tuple[str, Key], Floats] = {}
        for key in KEYS:
            scores[SIMULATED, key] = np.array([compare_ink(ink, simulated, key) for ink in inks])
            scores[REFERENCE, key] = np.array([compare_ink(reference, ink, key) for ink in inks])
            scores[PLANNED, key] = np.array([compare_ink(reference, simulated, key)])
            scores[ANOTHER, key] = pair_means(
                len(inks), lambda k, others, key=key: np.array([compare_ink(inks[k], inks[j], key) for j in others])
            )
        return scores

    def ranked(self) -> list[str]:
        """Stroke ids by CSIM against the reference (`HEADLINE`), best first."""
        order = np.argsort(-self.scores[REFERENCE, HEADLINE][:, 0], kind="stable")
        return [list(self.captured)[k] for k in order]


class Table3Row(Frozen):
    """One comparison over the writings of one character, in percent."""

    character: str
    reference: str
    """Font or file that the wanted image comes from."""
    pair: str
    """What was compared with what."""
    alignment: Alignment
    tone: Tone
    polarity: Polarity
    csim: Summary
    ssim: Summary


class WrittenRecord(Sealed):
    """Written characters as their `written.json` holds them: everything but the images and the single scores."""

    FILE: ClassVar[str] = "written.json"
    FORMAT: ClassVar[str] = "brushloop-written-2"
    MADE_BY: ClassVar[str] = "brushloop write compare"

    source: Source
    session: str
    recording_sha256: str
    brush: str
    """Name in the recording."""
    model: str
    cell_mm: float
    table_3: tuple[Table3Row, ...]
    refused: tuple[Refused, ...]
    figure_13_sha256: str
    """Of Figure 13 in the same folder."""
    software: str
    command: str

    @property
    def characters(self) -> tuple[str, ...]:
        """Their names, in the table's order."""
        return tuple(dict.fromkeys(row.character for row in self.table_3))


@dataclass(frozen=True)
class WritingComparison:
    """Written characters, compared with their plan."""

    session: OpenSession
    plan: Plan
    characters: list[Character]
    refused: tuple[Refused, ...] = ()
    cut: tuple[str, ...] = ()
    """Writings whose ink reaches the edge of their patch."""

    @functools.cached_property
    def table_3(self) -> tuple[Table3Row, ...]:
        """The rows, by character, then in the order of `KEYS` and `PAIRS`; without those that compare nothing."""
        rows: list[Table3Row] = []
        for character, key, pair in itertools.product(self.characters, KEYS, PAIRS):
            csim, ssim = (summarise(percent) for percent in 100.0 * character.scores[pair, key].T)
            if csim is not None and ssim is not None:
                row = (character.figure.name, character.figure.source, pair, *key, csim, ssim)
                rows.append(Table3Row.model_validate(dict(zip(Table3Row.model_fields, row, strict=True))))
        return tuple(rows)


def compare(request: CompareWrittenRequest, progress: Progress = unseen) -> Written:
    """Compare written characters with their simulation and reference; write the report. Raises `CalibrationError`."""
    check_writable(request.out)
    written = compare_written(request.session, load_plan(request.plan), progress)
    report = write_written(written, request.out, request.command)
    return Written(report, (*summary(written), f"Picture: {request.out / PICTURE}", f"Report:  {report}"))


def compare_written(path: Path, plan: Plan, progress: Progress = unseen) -> WritingComparison:
    """Read the writings of a session beside their plan.

    Raises `CalibrationError` if the two do not belong together or nothing can be compared.
    """
    session, refused = open_session(path), list[Refused]()
    commanded = {figure.name: figure.commanded for figure in plan.figures}
    for name, strokes in recorded_figures(session.header).items():
        if commanded.get(name) != as_points(strokes):
            raise CalibrationError(str(session.recording.path), f"{name!r} was not written from this plan")
    writings, cut = dict[str, dict[str, Ink]](), list[str]()
    for stroke_id, name, prepared in read_writings(session, refused, progress):
        ink = {Tone.BINARY: images.shrunk(prepared.mask.astype(np.float32)), Tone.GRAY: images.shrunk(prepared.soft)}
        writings.setdefault(name, {})[stroke_id] = ink
        if prepared.cut:
            cut.append(stroke_id)
    characters = [Character(figure, writings[figure.name]) for figure in plan.figures if figure.name in writings]
    if not characters:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(str(session.recording.path), f"no character can be compared{why}")
    return WritingComparison(session, plan, characters, tuple(refused), tuple(cut))


def read_writings(
    session: OpenSession, refused: list[Refused], progress: Progress
) -> Iterator[tuple[str, str, Prepared]]:
    """Yield stroke id, name of the figure and ink of every patch that the arm wrote on; the others go to `refused`.

    Raises `CalibrationError` for an import.
    """
    if session.calibration is None:
        raise CalibrationError(str(session.recording.path), "is an import: it holds no figures that the arm wrote")
    what = f"{session.header.session_id}: found"
    for capture in counted(session.recording.captures(), what, len(session.strokes), progress):
        stroke_id = capture.stroke.stroke_id
        try:
            prepared = prepare_patch(capture, session.calibration)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((stroke_id, error.what))
        else:
            yield stroke_id, stroke_id.rsplit("-r", 1)[0], prepared


def compare_ink(fixed: Ink, moving: Ink, key: Key) -> Floats:
    """(2,) CSIM and SSIM of the ink of two patches. Raises ValueError for a blank one."""
    alignment, tone, polarity = key
    one, other = (images.to_tone(aligned(ink[tone], alignment), tone) for ink in (fixed, moving))
    return images.similarity(one, other[None], alignment, polarity)[0]


def aligned(ink: Image, alignment: Alignment) -> Image:
    """(128, 128) as it is, or with the longer side of its ink scaled to 100 px and its bounding box in the middle."""
    if alignment is Alignment.MM:
        return ink
    rows, columns = (np.flatnonzero((ink > 0.5).any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        raise ValueError("holds no ink")
    step_px = float(1 + max(np.ptp(rows), np.ptp(columns))) / images.NORMAL_LENGTH_PX
    left, top = (0.5 * float(at[0] + at[-1] + 1 - SIZE_PX * step_px) for at in (columns, rows))
    return images.averaged(ink, (left, top), step_px, SIZE_PX, fine=1).clip(0.0, 1.0)


def round_of(character: Character, side_mm: float) -> Round:
    """What the writings of a figure show on average; phases for characters only."""
    figure, writings = character.figure, character.captured.values()
    wanted = figure.wanted
    csim = float(np.mean([compare_ink(dict.fromkeys(Tone, wanted), ink, HEADLINE)[0] for ink in writings]))
    lost: dict[str, float] = {}
    if figure.medians:
        where = phase_map(figure.paths, side_mm, len(wanted))
        wrong = np.mean([(wanted > 0.5) != (ink[Tone.BINARY] > 0.5) for ink in writings], axis=0)
        share = 100.0 * np.bincount(where.ravel(), wrong.ravel(), len(Phase)) / max(1, np.count_nonzero(wanted > 0.5))
        present = np.unique(where)
        lost = {str(phase): round(float(share[k]), 2) for k, phase in enumerate(Phase) if k in present}
    return Round(csim_percent=round(100.0 * csim, 3), lost_percent=lost)


def summary(written: WritingComparison) -> Iterator[str]:
    """Lines for the terminal: the strict and the lenient comparison, ink = 1."""
    source, writings = written.session.header.source, sum(len(each.captured) for each in written.characters)
    yield f"{writings} characters written, {len(written.refused)} not compared ({source})"
    for row in written.table_3:
        if row.polarity is Polarity.INK and row.tone is Tone.BINARY:
            csim, ssim = ("{:.2f} / {:.2f} / {:.2f}".format(*of.range_and_avg) for of in (row.csim, row.ssim))
            yield f"{row.character} {row.alignment}, {row.pair}: CSIM {csim}, SSIM {ssim}"
    yield from agreement(written)


def agreement(written: WritingComparison) -> Iterator[str]:
    """A sentence for each character: how alike writing and model are, and how alike two writings of one plan are."""
    for character in written.characters:
        scores = (character.scores[pair, (Alignment.MM, Tone.BINARY, Polarity.PAPER)] for pair in (SIMULATED, ANOTHER))
        model, writing = (summarise(100.0 * each[:, 1]) for each in scores)
        if model is not None and writing is not None:
            yield (
                f"{character.figure.name}: SSIM {model.avg:.1f} % between the writings and the simulated image, "
                f"{writing.avg:.1f} % between the writings (mm, binary, paper as 1)."
            )


def write_written(written: WritingComparison, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(written, folder / PICTURE)
    picture = (folder / PICTURE).read_bytes()
    session, plan, header = written.session, written.plan, written.session.header
    record = WrittenRecord(
        source=header.source,
        session=header.session_id,
        recording_sha256=session.sha256,
        brush=header.brush,
        model=plan.model,
        cell_mm=plan.cell_mm,
        table_3=written.table_3,
        refused=written.refused,
        figure_13_sha256=hashlib.sha256(picture).hexdigest(),
        software=made_by(),
        command=command,
    )
    page = render(
        "written.html.j2",
        **about(header),
        written=written,
        ways=list(itertools.product(Tone, (Alignment.SIZE_NORMALISED, Alignment.MM))),
        order=list(itertools.product(PAIRS, Polarity)),
        paper_rows=PAPER_ROWS,
        agreement=list(agreement(written)),
        rounds=[[*each.figure.rounds, round_of(each, plan.cell_mm)] for each in written.characters],
        phases=[str(phase) for phase in Phase],
        ssim_settings=SSIM_SETTINGS,
        picture=data_uri(picture),
        header=header.model_copy(update={"protocol": ""}),  # the plan, point by point
        provenance=(("compared with", record.software), ("command", command)),
    )
    write_files(folder, {TABLE: scores_csv(written), record.FILE: record.sealed().to_json(), PAGE: page})
    return folder / PAGE


def scores_csv(written: WritingComparison) -> str:
    """Every score as the text of a CSV file; the stroke id is empty where no writing is involved."""
    head = ["character", "stroke_id", "pair", "alignment", "tone", "polarity", "csim", "ssim", "source"]
    source, rows = str(written.session.header.source), list[tuple[str, ...]]()
    for character in written.characters:
        for (pair, key), scores in character.scores.items():
            names = [""] if pair == PLANNED else character.captured
            for stroke_id, (csim, ssim) in zip(names, scores.tolist(), strict=True):
                if np.isfinite(csim):
                    rows.append((character.figure.name, stroke_id, pair, *key, f"{csim:.6f}", f"{ssim:.6f}", source))
    return csv_text(head, rows)


def draw(written: WritingComparison, path: Path) -> None:
    """Draw Figure 13, a row per character: reference, simulated, best and worst writing, all writings over reference.

    Raises OSError.
    """
    header, count = written.session.header, len(written.characters)
    title = f"{header.session_id} ({header.source})"
    figure, rows = picture_grid(count, 5, (13.0, 0.5 + 2.9 * count), title)
    for character, axes in zip(written.characters, rows, strict=True):
        names, reference = character.ranked(), character.figure.wanted
        parts: tuple[tuple[str, Image], ...] = (
            (f"reference {code_points(character.figure.name)}", reference),
            ("simulated", character.figure.simulated),
            (f"captured, best of {len(names)}", character.captured[names[0]][Tone.GRAY]),
            ("captured, worst", character.captured[names[-1]][Tone.GRAY]),
            ("blue: mean of all captured; orange: reference", overlay(reference, character.mean_ink())),
        )
        for axis, (text, image) in zip(axes, parts, strict=True):
            axis.set_title(text, fontsize=8, pad=2)
            axis.set(xticks=[], yticks=[])
            ink = 1 - image if image.ndim == 2 else image
            axis.imshow(ink, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    save_picture(figure, path)
