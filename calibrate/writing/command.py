"""`brushloop write plan`, `compare`, `learn`, `practice` and `fit` as functions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare.place import Image
from brushloop.calibrate.drags.artefact import DragArtefact
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import check_folder
from brushloop.calibrate.report import Written
from brushloop.calibrate.writing.compare import compare_written, read_reference
from brushloop.calibrate.writing.footprint import TILT_DEG, fit_session, load_footprint, write_practice
from brushloop.calibrate.writing.learn import learned, lost_in_words
from brushloop.calibrate.writing.plan import Settings
from brushloop.calibrate.writing.plan import plan as planned
from brushloop.calibrate.writing.plan_files import PICTURE as PLAN_PICTURE
from brushloop.calibrate.writing.plan_files import write_plan, write_record
from brushloop.calibrate.writing.plan_record import PlannedBy, load_plan
from brushloop.calibrate.writing.report import PICTURE, summary, write_written
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.plan import Cell
from brushloop.model.strokes import UnknownModelError, stroke_model
from brushloop.sessions.terminal import Progress, unseen


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Which characters are planned, and how."""

    what: str
    """Characters, or a .csv or .json trajectory."""
    out: Path
    radius_mm: float = 6.0
    length_mm: float = 48.0
    data: Path | None = None
    """Folder of hanzi-writer files, or makemeahanzi's graphics.txt."""
    model: str = "ccd-bsm"
    drag: Path | None = None
    """Result of `fit --drags`."""
    footprint: Path | None = None
    """Result of `write fit`."""
    lam: float | None = None
    """lambda of CCD-BSM; None is pi."""
    cell_mm: float = 70.0
    margin_mm: float = 6.0
    depth_range_mm: tuple[float, float] = (0.5, 20.0)
    tilt_range_deg: tuple[float, float] = (0.0, 10.0)
    tilt_deg: float = 5.0
    """The initial tilt."""
    speed_mm_s: float = 15.0
    wrist_deg_s: float = 180.0
    steps: int = 60
    """Steps of refinement."""
    repeats: int = 1


def plan(request: PlanRequest, _progress: Progress = unseen) -> Written:
    """Plan characters and write their protocol. Raises `CalibrationError`."""
    check_folder(request.out)
    lagging = load_artefact(request.drag, DragArtefact) if request.drag is not None else None
    fitted = load_footprint(request.footprint) if request.footprint is not None else None
    if lagging is not None and fitted is not None:
        raise CalibrationError("write plan", "give --drag or --footprint, not both")
    try:
        if request.tilt_range_deg[1] > 30 or request.depth_range_mm[0] <= 0:
            raise ValueError("tilts end at 30 deg, depths begin above 0 mm")
        turn_deg_mm = request.wrist_deg_s / request.speed_mm_s
        reach = Reach(request.depth_range_mm, request.tilt_range_deg, turn_deg_mm=turn_deg_mm)
        seen = lagging.model() if lagging is not None else None
        cell = Cell(request.cell_mm, request.margin_mm)
        settings = Settings(cell, reach, request.tilt_deg, steps=request.steps, drag=seen)
        if fitted is not None:
            settings = replace(settings, footprint=fitted.footprint())
        brush = Brush(request.radius_mm, request.length_mm)
        of = stroke_model(request.model, brush, math.pi if request.lam is None else request.lam)
        of.profile(request.depth_range_mm[1], request.tilt_range_deg[1])
    except (ValueError, UnknownModelError, DomainError) as error:
        raise CalibrationError("write plan", str(error)) from None
    figures = planned(request.what, request.data, of, settings)
    by = PlannedBy(
        model=request.model,
        radius_mm=request.radius_mm,
        length_mm=request.length_mm,
        lam=request.lam,
        depth_range_mm=request.depth_range_mm,
        tilt_range_deg=request.tilt_range_deg,
        turn_deg_mm=reach.turn_deg_mm,
        speed_mm_s=request.speed_mm_s,
        drag_fit=lagging.digest if lagging is not None else "",
        footprint=fitted.footprint().values if fitted is not None else None,
    )
    label = of.label if fitted is None else "fitted footprint"
    protocol = write_plan(figures, settings, by, label, request.repeats, request.out)
    if fitted is not None:
        said = [f"simulated with the footprint fitted to {fitted.session_id}, {fitted.source}: not ink"]
    elif lagging is None:
        said = [f"simulated by {request.model}, marks laid over each other along the way: not ink"]
    else:
        said = [f"simulated with the bristle lag of {lagging.session_id}, {lagging.source}: not ink"]
    for figure in figures:
        first_csim, first_ssim, last_csim, last_ssim = figure.scores()
        points = sum(len(stroke) for stroke in figure.strokes)
        said.append(
            f"{figure.request.name}: {len(figure.strokes)} strokes, {points} points, ink = 1: "
            f"CSIM {first_csim:.4f} -> {last_csim:.4f}, SSIM {first_ssim:.4f} -> {last_ssim:.4f}"
        )
    return Written(protocol, (*said, str(protocol), str(request.out / PLAN_PICTURE)))


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Which written characters are compared, and where the report goes."""

    session: Path
    plan: Path
    """The plan's folder, or its plan.json."""
    out: Path
    command: str
    """Named by the report as what made it."""
    references: tuple[str, ...] = ()
    """Pictures to compare with instead of the plan's font, as `CHARACTER=FILE`."""


def compare(request: CompareRequest, progress: Progress = unseen) -> Written:
    """Compare written characters with their simulation and reference; write the report. Raises `CalibrationError`."""
    check_folder(request.out)
    references: dict[str, tuple[str, Image]] = {}
    for given in request.references:
        name, equals, path = given.partition("=")
        if not name or not equals or not path:
            raise CalibrationError("--reference", f"{given!r}: expected CHARACTER=FILE, as 字=zi.png")
        references[name] = (Path(path).name, read_reference(Path(path)))
    written = compare_written(request.session, load_plan(request.plan), references, progress)
    report = write_written(written, request.out, request.command)
    return Written(report, (*summary(written), f"Picture: {request.out / PICTURE}", f"Report:  {report}"))


@dataclass(frozen=True, slots=True)
class LearnRequest:
    """From which session the next plan is made."""

    session: Path
    plan: Path
    """The plan that was written: its folder, or its plan.json."""
    out: Path
    gain: float = 0.7
    """Share of the miss that is corrected."""
    repeats: int = 1
    settled_repeats: int | None = None
    """The same, used once every character is settled."""


def learn(request: LearnRequest, progress: Progress = unseen) -> Written:
    """Make the next plan from what the ink of this one showed. Raises `CalibrationError`."""
    check_folder(request.out)
    made, lessons = learned(compare_written(request.session, load_plan(request.plan), {}, progress), request.gain)
    request.out.mkdir(parents=True, exist_ok=True)
    settled = request.settled_repeats is not None and all(one.settled for one in lessons)
    protocol = write_record(made, (request.settled_repeats if settled else None) or request.repeats, request.out)
    said = [
        f"{one.name}: CSIM {one.found.csim_percent:.2f}, ink = 1, mm; lost in {lost_in_words([one.found])}"
        + ("; settled: the best round is kept" if one.settled else "")
        for one in lessons
    ]
    return Written(protocol, (*said, str(protocol)))


@dataclass(frozen=True, slots=True)
class PracticeRequest:
    """What a practice sheet holds."""

    out: Path
    radius_mm: float = 6.0
    length_mm: float = 48.0
    cell_mm: float = 70.0
    depth_range_mm: tuple[float, float] = (0.5, 20.0)
    speed_mm_s: float = 15.0
    wrist_deg_s: float = 180.0
    seed: int = 1


def practice(request: PracticeRequest, _progress: Progress = unseen) -> Written:
    """Write the protocol of a practice sheet. Raises `CalibrationError`."""
    check_folder(request.out)
    turn_deg_mm = request.wrist_deg_s / request.speed_mm_s
    try:
        Reach(request.depth_range_mm, turn_deg_mm=turn_deg_mm)
    except ValueError as error:
        raise CalibrationError("write practice", str(error)) from None
    by = PlannedBy(
        model="ccd-bsm",
        radius_mm=request.radius_mm,
        length_mm=request.length_mm,
        lam=None,
        depth_range_mm=request.depth_range_mm,
        tilt_range_deg=(0.0, 2.0 * TILT_DEG),
        turn_deg_mm=turn_deg_mm,
        speed_mm_s=request.speed_mm_s,
    )
    protocol = write_practice(request.out, request.cell_mm, by, request.seed)
    return Written(protocol, (str(protocol),))


def fit(session: Path, progress: Progress = unseen) -> Written:
    """Fit the footprint of the dragged brush and put it to use. Raises `CalibrationError`."""
    made, path = fit_session(session, progress)
    said = (
        f"footprint of {made.strokes} strokes on {made.images} cells ({made.source}): draws them with CSIM "
        f"{made.csim_percent:.1f} %, ink = 1"
    )
    return Written(path, (said, str(path)))
