"""`brushloop loop compare` as a function, and its report: a page, a picture, and every number as CSV and JSON."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.paper import ROBOT_WRITING, TABLE_1
from brushloop.calibrate.compare.place import KEYS, Alignment, Field, Tone
from brushloop.calibrate.files import check_folder
from brushloop.calibrate.loop.compare import NOT_AGAIN, LoopComparison, compare_sessions
from brushloop.calibrate.loop.scores import (
    AGAIN,
    GOAL_POINTS,
    LoopRecord,
    Pair,
    PairScore,
    Verdict,
    scores_of,
    table_1,
)
from brushloop.calibrate.loop.scores import FILE as NUMBERS
from brushloop.calibrate.report import (
    BLUE,
    Point,
    Written,
    dress,
    ink_uri,
    overlay,
    overlay_uri,
    picture_grid,
    plot,
    plot_uri,
    render,
    save_picture,
    show_picture,
    source_label,
    source_note,
    source_point,
    write_files,
)
from brushloop.calibrate.session import OpenSession
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.disk import csv_text
from brushloop.sessions.terminal import Progress, unseen

HEADLINE, GRAY = (Alignment.MM, Tone.BINARY), (Alignment.MM, Tone.GRAY)
PICTURE, PAGE, TABLE = "loop.png", "loop.html", "loop.csv"
COLUMNS = ("original", "again", "depth_mm", "tilt_deg", "what", "alignment", "tone", "csim", "ssim", "source")
SHEET_ROWS = slice(32, 96)
"""Rows shown, the middle half: a press is at most half as thick as the field is high."""
MAX_PICTURE_ROWS = 12
MAX_PAIRS_SHOWN = 150


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Which sessions are compared, and where the report goes."""

    original: Path
    again: Path
    """The session of the replay protocol."""
    out: Path
    command: str
    """Named by the report as what made it."""
    fit: Path | None = None
    """Brush fit that recovered depth and tilt; None is CCD-BSM as published."""
    mm_per_px: float = MM_PER_PX


def compare(request: CompareRequest, progress: Progress = unseen) -> Written:
    """Compare presses with those that repeat them, and write the report. Raises `CalibrationError` and OSError."""
    check_folder(request.out)
    loop = compare_sessions(request.original, request.again, request.fit, Field(mm_per_px=request.mm_per_px), progress)
    record = record_of(loop, request.command)
    page = write_loop(loop, record, request.out)
    return Written(page, (*summary(loop, record), f"Picture: {request.out / PICTURE}", f"Report:  {page}"))


def write_loop(loop: LoopComparison, record: LoopRecord, folder: Path) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(loop, folder / PICTURE)
    header, source = loop.original.header, record.source
    paper = TABLE_1[ROBOT_WRITING]
    label = source_label(source, [header.brush])
    page = render(
        "loop.html.j2",
        header=header,
        again=loop.again.header,
        label=label,
        note=source_note(source, header.brush),
        trust=[source_point(source), *_trust(loop)],
        plot=_recovered(loop, label),
        beside=(PICTURE, TABLE, NUMBERS),
        model=loop.model,
        goal=f"{GOAL_POINTS:g}",
        pairs=len(loop.pairs),
        answer=answer(loop.verdicts),
        verdicts=loop.verdicts,
        tables=[(key, [row for row in record.table_1 if (row.alignment, row.tone) == key]) for key in KEYS],
        paper=(paper.csim, paper.ssim),
        rows=_rows(loop),
        not_shown=max(0, len(loop.pairs) - MAX_PAIRS_SHOWN),
        refused=loop.refused,
        field=loop.field,
        ssim_settings=SSIM_SETTINGS,
        provenance=list(_provenance(loop, record)),
    )
    write_files(folder, {TABLE: loop_csv(loop.scores, source), NUMBERS: record.to_json(), PAGE: page})
    return folder / PAGE


def record_of(loop: LoopComparison, command: str) -> LoopRecord:
    """The loop without images and individual scores, with its digest."""
    original, again = loop.original, loop.again
    about: dict[str, Any] = {
        "source": again.header.source,
        "original": original.header.session_id,
        "again": again.header.session_id,
        "model": loop.model,
    }
    return LoopRecord(
        **about,
        original_sha256=original.sha256,
        again_sha256=again.sha256,
        in_sample=loop.in_sample,
        mm_per_px=loop.field.mm_per_px,
        pairs=len(loop.pairs),
        goal_points=GOAL_POINTS,
        table_1=tuple(table_1(loop.scores, **about)),
        verdicts=tuple(loop.verdicts),
        refused=tuple(loop.refused),
        software=made_by(),
        command=command,
    ).sealed()


def answer(verdicts: list[Verdict]) -> str:
    """The result in one sentence."""
    if not verdicts:
        return "No cell of the original session was pressed twice, so its repeatability is not known."
    failed = [v for v in verdicts if not v.holds]
    least = min(verdicts, key=lambda v: v.difference)
    where = f"least: {least.difference:+.2f} points, {least.measure.upper()}, {least.alignment}, {least.tone}"
    if not failed:
        return (
            f"In all {len(verdicts)} comparisons the re-pressed strokes are as similar to their originals as the "
            f"brush's own presses are to each other, or less than {GOAL_POINTS:g} point less similar ({where})."
        )
    return (
        f"In {len(failed)} of {len(verdicts)} comparisons the re-pressed strokes score more than {GOAL_POINTS:g} "
        f"point below other presses of the same cell against their originals ({where})."
    )


def summary(loop: LoopComparison, record: LoopRecord) -> Iterator[str]:
    """Lines for the terminal."""
    yield f"{len(loop.pairs)} presses repeated, {len(loop.refused)} not compared ({record.source})"
    for alignment, tone in KEYS:
        rows = [row for row in record.table_1 if (row.alignment, row.tone) == (alignment, tone)]
        parts = "; ".join(f"{row.what} {row.csim[2]:.2f} / {row.ssim[2]:.2f}" for row in rows)
        yield f"{alignment}, {tone}, CSIM / SSIM: {parts}"
    yield answer(loop.verdicts)


def loop_csv(scores: list[PairScore], source: str) -> str:
    """A CSV row for every comparison with every original."""
    rows = (
        (s.original, s.again, *astuple(s.condition)[:2], s.what, s.alignment, s.tone, f"{s.csim:.6f}", f"{s.ssim:.6f}")
        for s in scores
    )
    return csv_text(COLUMNS, ((*row, source) for row in rows))


def draw(loop: LoopComparison, path: Path) -> None:
    """Draw one row per pair: original, simulation of the recovered press, re-pressed, overlay. Raises OSError."""
    pairs = _in_picture(loop)
    scores = _again_scores(loop)
    title = f"{loop.original.header.session_id}, pressed again ({loop.again.header.source})"
    figure, rows = picture_grid(len(pairs), 4, (10.0, 0.6 + 1.35 * len(pairs)), title)
    side = loop.field.side_mm
    extent = (0.0, side, 0.25 * side, 0.75 * side)
    for pair, axes in zip(pairs, rows, strict=True):
        original, again = pair.original, pair.again
        score = scores[again.stroke.stroke_id]
        asked, recovered = original.condition, again.condition
        titles = (
            f"{original.stroke.stroke_id}: H {asked.depth_mm:g} mm, alpha {asked.tilt_deg:g} deg",
            f"recovered: H {recovered.depth_mm:.2f} mm, alpha {recovered.tilt_deg:.1f} deg",
            f"re-pressed: CSIM {score.csim:.3f}, SSIM {score.ssim:.3f}",
            "gray both, orange original only, blue again only",
        )
        images = _gray_images(pair)
        images.append(overlay(images[0], images[2]))
        for axis, image, text in zip(axes, images, titles, strict=True):
            show_picture(axis, image, text, fontsize=7, extent=extent)
    save_picture(figure, path)


def _in_picture(loop: LoopComparison) -> list[Pair]:
    """Choose at most `MAX_PICTURE_ROWS` pairs, evenly over depth and tilt, the worst included."""
    pairs = sorted(loop.pairs, key=lambda p: (p.original.condition, p.again.stroke.stroke_id))
    if len(pairs) <= MAX_PICTURE_ROWS:
        return pairs
    worst = min(scores_of(loop.scores, AGAIN, GRAY), key=lambda score: score.csim)
    chosen = {round(k) for k in np.linspace(0, len(pairs) - 1, MAX_PICTURE_ROWS - 1)}
    chosen |= {k for k, pair in enumerate(pairs) if pair.again.stroke.stroke_id == worst.again}
    return [pairs[k] for k in sorted(chosen)]


def _again_scores(loop: LoopComparison) -> dict[str, PairScore]:
    """Score of each repetition by name, from the headline comparison (mm, binary)."""
    return {score.again: score for score in scores_of(loop.scores, AGAIN, HEADLINE)}


def _gray_images(pair: Pair) -> list[Any]:
    """Original, simulated and re-pressed, the middle of each field."""
    return [image[GRAY][SHEET_ROWS] for image in (pair.original.images, pair.simulated, pair.again.images)]


def _rows(loop: LoopComparison) -> list[dict[str, Any]]:
    scores = _again_scores(loop)
    pairs = sorted(loop.pairs, key=lambda p: scores[p.again.stroke.stroke_id].csim)
    rows: list[dict[str, Any]] = []
    for pair in pairs[:MAX_PAIRS_SHOWN]:
        images = _gray_images(pair)
        rows.append(
            {
                "original": pair.original,
                "again": pair.again,
                "score": scores[pair.again.stroke.stroke_id],
                "images": {
                    "original": ink_uri(images[0]),
                    "recovered, simulated": ink_uri(images[1]),
                    "pressed again": ink_uri(images[2]),
                    "original and pressed again": overlay_uri(images[0], images[2]),
                },
            }
        )
    return rows


def _trust(loop: LoopComparison) -> Iterator[Point]:
    failed = [v for v in loop.verdicts if not v.holds]
    uncertain = sum(not v.certain for v in loop.verdicts)
    if not loop.verdicts:
        yield Point(None, "No cell of the original session was pressed twice: the brush's repeatability is not known.")
    elif failed:
        yield Point(False, f"{len(failed)} of {len(loop.verdicts)} comparisons miss the goal of {GOAL_POINTS:g} point.")
    else:
        yield Point(True, f"All {len(loop.verdicts)} comparisons stay within {GOAL_POINTS:g} point of another press.")
    if uncertain:
        words = "there are so few presses that the interval includes the limit or is not known"
        yield Point(None, f"{uncertain} of {len(loop.verdicts)} comparisons are not certain: {words}.")
    if loop.in_sample:
        words = "The model that recovered them was fitted to these same presses, with their commanded depths and tilts"
        yield Point(
            None, f"{words}: recovered numbers near the commanded ones prove nothing about it. Compare the marks."
        )
    left = sum(why == NOT_AGAIN for _, why in loop.refused)
    if left:
        yield Point(None, f"{'One original was' if left == 1 else f'{left} originals were'} not pressed again.")
    if len(loop.refused) > left:
        yield Point(False, f"{len(loop.refused) - left} strokes could not be compared; each is named below.")
    else:
        yield Point(True, "Every stroke that was pressed again was compared.")


def _recovered(loop: LoopComparison, label: str) -> str:
    """Depth and tilt as recovered against as commanded, with the line where both are equal."""
    figure, axes = plot(1, 2, (10.0, 3.8))
    pairs = [(pair.original.condition, pair.again.condition) for pair in loop.pairs]
    values = (
        ("depth H, mm", [(original.depth_mm, again.depth_mm) for original, again in pairs]),
        ("tilt α, deg", [(original.tilt_deg, again.tilt_deg) for original, again in pairs]),
    )
    for axis, (name, points) in zip(axes, values, strict=True):
        low, high = min(map(min, points)), max(map(max, points))
        margin = 0.05 * (high - low) or 0.5
        axis.plot([low - margin, high + margin], [low - margin, high + margin], color="0.6", lw=1.0)
        axis.plot([x for x, _ in points], [y for _, y in points], "o", ms=4, alpha=0.6, color=BLUE)
        dress(axis, f"{name.split(',')[0]} ({label})", f"commanded {name}", f"recovered {name}")
    return plot_uri(figure)


def _provenance(loop: LoopComparison, record: LoopRecord) -> Iterator[tuple[str, str]]:
    for name, session in (("original", loop.original), ("re-pressed", loop.again)):
        yield from _of_session(name, session)
    header = loop.again.header
    yield "robot", f"{header.robot} {header.robot_firmware}".strip()
    yield "brush, ink, paper", ", ".join(part for part in (header.brush, header.ink, header.paper) if part)
    yield "recovered by", loop.model
    yield "compared with", f"{record.software}, Python {platform.python_version()}"
    yield "command", record.command


def _of_session(name: str, session: OpenSession) -> Iterator[tuple[str, str]]:
    yield f"{name}, source", str(session.header.source)
    yield f"{name}, recording", f"{session.recording.path.name}, sha256 {session.sha256}"
    if session.calibration is not None:
        calibration = session.calibration
        yield f"{name}, calibration", f"{calibration.named}, pix2len {calibration.mm_per_px:.5f} mm/px"
