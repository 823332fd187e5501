"""`brushloop write plan`, `compare` and `learn`. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.sessions.terminal import say


def plan(
    what: Annotated[str, typer.Argument(help="Characters (字 子 永 are shipped), or a .csv or .json trajectory.")],
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml and plan.png.")] = Path("write-plan"),
    data: Annotated[
        Path | None, typer.Option(help="Folder of hanzi-writer files, or makemeahanzi's graphics.txt.")
    ] = None,
    model: Annotated[
        str, typer.Option(help="Stroke model that plans and draws; without influence with --footprint.")
    ] = "ccd-bsm",
    radius_mm: Annotated[float, typer.Option(min=0.5, max=50, help="Radius R of the brush.")] = 6.0,
    length_mm: Annotated[float, typer.Option(min=5, max=200, help="Length L of the brush.")] = 48.0,
    drag: Annotated[
        Path | None, typer.Option(help="Result of `fit --drags`: strokes that travel are drawn with its bristle lag.")
    ] = None,
    footprint: Annotated[
        Path | None,
        typer.Option(help="Result of `write fit`: the plan leads the brush by the footprint of its own drags."),
    ] = None,
    lam: Annotated[float | None, typer.Option(min=0.1, max=10, help="Lambda of CCD-BSM; pi by default.")] = None,
    cell_mm: Annotated[float, typer.Option(min=10, max=500, help="Side of the character's paper cell.")] = 70.0,
    margin_mm: Annotated[float, typer.Option(min=0, max=200, help="Margin around the font's square.")] = 6.0,
    depth_range: Annotated[tuple[float, float], typer.Option(help="Least and greatest depth, mm.")] = (0.5, 20.0),
    tilt_range: Annotated[tuple[float, float], typer.Option(help="Least and greatest tilt, deg; at most 30.")] = (
        0.0,
        10.0,
    ),
    tilt: Annotated[float, typer.Option(min=0, max=30, help="Initial tilt, deg.")] = 5.0,
    speed_mm_s: Annotated[float, typer.Option(min=1, max=100, help="Speed of the tip.")] = 15.0,
    wrist_deg_s: Annotated[float, typer.Option(min=1, max=720, help="Greatest speed of the wrist.")] = 180.0,
    steps: Annotated[int, typer.Option(min=0, max=1000, help="Steps of refinement; 0 keeps the first plan.")] = 60,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written.")] = 1,
) -> None:
    """Plan characters: depth from the width of each stroke, heading along it, then refined until the image matches."""
    import math
    from dataclasses import replace

    from brushloop.calibrate.artefact import load_artefact
    from brushloop.calibrate.drags.artefact import DragArtefact
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_folder
    from brushloop.calibrate.writing.footprint import load_footprint
    from brushloop.calibrate.writing.plan import Settings
    from brushloop.calibrate.writing.plan import plan as planned
    from brushloop.calibrate.writing.plan_files import PICTURE, write_plan
    from brushloop.calibrate.writing.plan_record import PlannedBy
    from brushloop.model.brush import Brush, DomainError
    from brushloop.model.characters.brush import Reach
    from brushloop.model.characters.plan import Cell
    from brushloop.model.strokes import UnknownModelError, stroke_model

    check_folder(out)
    lagging = load_artefact(drag, DragArtefact) if drag is not None else None
    fitted = load_footprint(footprint) if footprint is not None else None
    if lagging is not None and fitted is not None:
        raise CalibrationError("write plan", "give --drag or --footprint, not both")
    try:
        if tilt_range[1] > 30 or depth_range[0] <= 0:
            raise ValueError("tilts end at 30 deg, depths begin above 0 mm")
        reach = Reach(depth_range, tilt_range, turn_deg_mm=wrist_deg_s / speed_mm_s)
        seen = lagging.model() if lagging is not None else None
        settings = Settings(Cell(cell_mm, margin_mm), reach, tilt, steps=steps, drag=seen)
        if fitted is not None:
            settings = replace(settings, footprint=fitted.footprint())
        of = stroke_model(model, Brush(radius_mm, length_mm), math.pi if lam is None else lam)
        of.profile(depth_range[1], tilt_range[1])
    except (ValueError, UnknownModelError, DomainError) as error:
        raise CalibrationError("write plan", str(error)) from None
    figures = planned(what, data, of, settings)
    by = PlannedBy(
        model=model,
        radius_mm=radius_mm,
        length_mm=length_mm,
        lam=lam,
        depth_range_mm=depth_range,
        tilt_range_deg=tilt_range,
        turn_deg_mm=reach.turn_deg_mm,
        speed_mm_s=speed_mm_s,
        drag_fit=lagging.digest if lagging is not None else "",
        footprint=fitted.footprint().values if fitted is not None else None,
    )
    label = of.label if fitted is None else "fitted footprint"
    protocol = write_plan(figures, settings, by, label, repeats, out)
    if fitted is not None:
        say(f"simulated with the footprint fitted to {fitted.session_id}, {fitted.source}: not ink")
    elif lagging is None:
        say(f"simulated by {model}, marks laid over each other along the way: not ink")
    else:
        say(f"simulated with the bristle lag of {lagging.session_id}, {lagging.source}: not ink")
    for figure in figures:
        first_csim, first_ssim, last_csim, last_ssim = figure.scores()
        points = sum(len(stroke) for stroke in figure.strokes)
        say(
            f"{figure.request.name}: {len(figure.strokes)} strokes, {points} points, ink = 1: "
            f"CSIM {first_csim:.4f} -> {last_csim:.4f}, SSIM {first_ssim:.4f} -> {last_ssim:.4f}"
        )
    say(str(protocol), str(out / PICTURE))


def compare(
    session: Annotated[Path, typer.Argument(help="The session in which a plan was written.")],
    plan: Annotated[Path, typer.Option(help="The plan's folder, or its plan.json.")],
    reference: Annotated[
        list[str] | None, typer.Option(help="字=picture.png: compare with this picture instead of the plan's font.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for written.html, .csv, .json and figure-13.png.")] = Path(
        "written"
    ),
) -> None:
    """Compare written characters with the simulated image and with the reference, in both polarities (Table 3)."""
    import sys

    from brushloop.calibrate.compare.field import Image
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_folder
    from brushloop.calibrate.writing.compare import compare_written, read_reference
    from brushloop.calibrate.writing.plan_record import load_plan
    from brushloop.calibrate.writing.report import PICTURE, summary, write_written
    from brushloop.sessions.terminal import shown

    check_folder(out)
    references: dict[str, tuple[str, Image]] = {}
    for given in reference or []:
        name, equals, path = given.partition("=")
        if not name or not equals or not path:
            raise CalibrationError("--reference", f"{given!r}: expected CHARACTER=FILE, as 字=zi.png")
        references[name] = (Path(path).name, read_reference(Path(path)))
    with shown() as progress:
        written = compare_written(session, load_plan(plan), references, progress)
    report = write_written(written, out, " ".join(["brushloop", *sys.argv[1:]]))
    for line in summary(written):
        say(line)
    say(f"Picture: {out / PICTURE}", f"Report:  {report}")


def learn(
    session: Annotated[Path, typer.Argument(help="The session in which a plan was written.")],
    plan: Annotated[Path, typer.Option(help="The plan's folder, or its plan.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the next plan.")],
    gain: Annotated[float, typer.Option(min=0.05, max=1.5, help="Share of the miss that is corrected.")] = 0.7,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written next.")] = 1,
    settled_repeats: Annotated[
        int | None, typer.Option(min=1, max=1000, help="The same, used once every character is settled.")
    ] = None,
) -> None:
    """Make the next plan from what the ink of this one showed, phase by phase."""
    from brushloop.calibrate.files import check_folder
    from brushloop.calibrate.writing.compare import compare_written
    from brushloop.calibrate.writing.learn import learned
    from brushloop.calibrate.writing.plan_files import write_record
    from brushloop.calibrate.writing.plan_record import load_plan
    from brushloop.calibrate.writing.rounds import lost_in_words
    from brushloop.sessions.terminal import shown

    check_folder(out)
    with shown() as progress:
        made, lessons = learned(compare_written(session, load_plan(plan), {}, progress), gain)
    out.mkdir(parents=True, exist_ok=True)
    if settled_repeats is not None and all(one.settled for one in lessons):
        repeats = settled_repeats
    protocol = write_record(made, repeats, out)
    for one in lessons:
        ends = "; settled: the best round is kept" if one.settled else ""
        say(f"{one.name}: CSIM {one.found.csim_percent:.2f}, ink = 1, mm; lost in {lost_in_words([one.found])}{ends}")
    say(str(protocol))


def practice(
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml.")] = Path("practice"),
    length_mm: Annotated[
        float, typer.Option(min=5, max=200, help="Length L of the brush; strokes go no deeper than 0.3 of it.")
    ] = 48.0,
    radius_mm: Annotated[float, typer.Option(min=0.5, max=50, help="Radius R of the brush.")] = 6.0,
    cell_mm: Annotated[float, typer.Option(min=30, max=500, help="Side of each paper cell.")] = 70.0,
    depth_range: Annotated[tuple[float, float], typer.Option(help="Least and greatest depth, mm.")] = (0.5, 20.0),
    speed_mm_s: Annotated[float, typer.Option(min=1, max=100, help="Speed of the tip.")] = 15.0,
    wrist_deg_s: Annotated[float, typer.Option(min=1, max=720, help="Greatest speed of the wrist.")] = 180.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the strokes.")] = 1,
) -> None:
    """Plan a practice sheet: strokes from which `write fit` learns how this brush is dragged."""
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_folder
    from brushloop.calibrate.writing.plan_record import PlannedBy
    from brushloop.calibrate.writing.practice import TILT_DEG, write_practice
    from brushloop.model.characters.brush import Reach

    check_folder(out)
    turn_deg_mm = wrist_deg_s / speed_mm_s
    try:
        Reach(depth_range, turn_deg_mm=turn_deg_mm)
    except ValueError as error:
        raise CalibrationError("write practice", str(error)) from None
    by = PlannedBy(
        model="ccd-bsm",
        radius_mm=radius_mm,
        length_mm=length_mm,
        lam=None,
        depth_range_mm=depth_range,
        tilt_range_deg=(0.0, 2.0 * TILT_DEG),
        turn_deg_mm=turn_deg_mm,
        speed_mm_s=speed_mm_s,
    )
    say(str(write_practice(out, cell_mm, by, seed)))


def fit(
    session: Annotated[Path, typer.Argument(help="A calibrated session of a practice sheet, or of any figures.")],
) -> None:
    """Fit the footprint of the dragged brush, for `write plan --footprint`."""
    from brushloop.calibrate.writing.footprint import fit_session
    from brushloop.sessions.terminal import shown

    with shown() as progress:
        made, path = fit_session(session, progress)
    say(
        f"footprint of {made.strokes} strokes on {made.images} cells ({made.source}): draws them with CSIM "
        f"{made.csim_percent:.1f} %, ink = 1",
        str(path),
    )
