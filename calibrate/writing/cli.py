"""`brushloop write plan`, `compare`, `learn`, `practice` and `fit`. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def plan(
    what: Annotated[str, typer.Argument(help="Characters (字 子 永 are shipped), or a .csv trajectory.")],
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml and plan.png.")] = Path("write-plan"),
    data: Annotated[
        Path | None, typer.Option(help="Folder of hanzi-writer files, or makemeahanzi's graphics.txt.")
    ] = None,
    radius_mm: Annotated[float, typer.Option(min=0.5, max=50, help="Radius R of the brush.")] = 6.0,
    length_mm: Annotated[float, typer.Option(min=5, max=200, help="Length L of the brush.")] = 48.0,
    footprint: Annotated[
        Path | None,
        typer.Option(help="Result of `write fit`: the plan leads the brush by the footprint of its own drags."),
    ] = None,
    cell_mm: Annotated[float, typer.Option(min=30, max=500, help="Side of the character's patch of paper.")] = 70.0,
    depth_range: Annotated[tuple[float, float], typer.Option(help="Least and greatest depth, mm.")] = (0.5, 20.0),
    tilt_range: Annotated[tuple[float, float], typer.Option(help="Least and greatest tilt, deg; at most 30.")] = (
        0.0,
        10.0,
    ),
    speed_mm_s: Annotated[float, typer.Option(min=1, max=100, help="Speed of the tip.")] = 15.0,
    wrist_deg_s: Annotated[float, typer.Option(min=1, max=720, help="Greatest speed of the wrist.")] = 180.0,
    steps: Annotated[int, typer.Option(min=0, max=1000, help="Steps of refinement; 0 keeps the first plan.")] = 60,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written.")] = 1,
) -> None:
    """Plan characters: depth from the width of each stroke, heading along it, then refined until the image matches."""
    from brushloop.calibrate.writing.plan import PlanRequest
    from brushloop.calibrate.writing.plan import plan as run
    from brushloop.calibrate.writing.record import PlannedBy
    from brushloop.sessions.terminal import show_work

    by = PlannedBy(
        radius_mm=radius_mm,
        length_mm=length_mm,
        depth_range_mm=depth_range,
        tilt_range_deg=tilt_range,
        speed_mm_s=speed_mm_s,
        wrist_deg_s=wrist_deg_s,
    )
    show_work(run, PlanRequest(what, out, by, data, footprint, cell_mm, steps, repeats))


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

    from brushloop.calibrate.writing.compare import CompareRequest
    from brushloop.calibrate.writing.compare import compare as run
    from brushloop.sessions.terminal import show_work

    command = " ".join(["brushloop", *sys.argv[1:]])
    show_work(run, CompareRequest(session, plan, out, command, tuple(reference or ())))


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
    from brushloop.calibrate.writing.learn import LearnRequest
    from brushloop.calibrate.writing.learn import learn as run
    from brushloop.sessions.terminal import show_work

    show_work(run, LearnRequest(session, plan, out, gain, repeats, settled_repeats))


def practice(
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml.")] = Path("practice"),
    length_mm: Annotated[
        float, typer.Option(min=5, max=200, help="Length L of the brush; strokes go no deeper than 0.3 of it.")
    ] = 48.0,
    cell_mm: Annotated[float, typer.Option(min=30, max=500, help="Side of each patch of paper.")] = 70.0,
) -> None:
    """Plan a practice sheet: strokes from which `write fit` learns how this brush is dragged."""
    from brushloop.calibrate.writing.learn import PracticeRequest
    from brushloop.calibrate.writing.learn import practice as run
    from brushloop.calibrate.writing.record import PlannedBy
    from brushloop.sessions.terminal import show_work

    show_work(run, PracticeRequest(out, PlannedBy(length_mm=length_mm), cell_mm))


def fit(
    session: Annotated[Path, typer.Argument(help="A calibrated session of a practice sheet, or of any figures.")],
) -> None:
    """Fit the footprint of the dragged brush, for `write plan --footprint`."""
    from brushloop.calibrate.writing.learn import fit as run
    from brushloop.sessions.terminal import show_work

    show_work(run, session)
