"""`brushloop write compare`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say


def compare(
    session: Annotated[Path, typer.Argument(help="The session in which a plan was written.")],
    plan: Annotated[Path, typer.Option(help="The plan's folder, or its plan.json.")],
    reference: Annotated[
        list[str] | None, typer.Option(help="字=picture.png: compare with this, not with the plan's own font.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for written.html, .csv, .json and figure-13.png.")] = Path(
        "written"
    ),
) -> None:
    """Compare written characters with the simulated image and with the reference, in both polarities (Table 3)."""
    import sys

    from calibrate.compare.field import Image
    from calibrate.errors import CalibrationError
    from calibrate.files import check_folder
    from calibrate.writing.compare import compare_written
    from calibrate.writing.images import read_reference
    from calibrate.writing.record import load_plan
    from calibrate.writing.report import PICTURE, summary, write_written

    check_folder(out)
    references: dict[str, tuple[str, Image]] = {}
    for given in reference or []:
        name, equals, path = given.partition("=")
        if not name or not equals or not path:
            raise CalibrationError("--reference", f"{given!r}: expected CHARACTER=FILE, as 字=zi.png")
        references[name] = (Path(path).name, read_reference(Path(path)))
    written = compare_written(session, load_plan(plan), references)
    report = write_written(written, out, " ".join(["brushloop", *sys.argv[1:]]))
    for line in summary(written):
        say(line)
    say(f"Picture: {out / PICTURE}", f"Report:  {report}")


def learn(
    session: Annotated[Path, typer.Argument(help="The session in which a plan was written.")],
    plan: Annotated[Path, typer.Option(help="The plan's folder, or its plan.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the next plan.")],
    gain: Annotated[float, typer.Option(min=0.05, max=1.5, help="Share of what was off that is put right.")] = 0.8,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written next.")] = 1,
) -> None:
    """Move a plan's trajectories by what their ink was off, for the next writing."""
    from calibrate.files import check_folder
    from calibrate.writing.compare import compare_written
    from calibrate.writing.learn import learned
    from calibrate.writing.plan_files import write_record
    from calibrate.writing.record import load_plan

    check_folder(out)
    made, lessons = learned(compare_written(session, load_plan(plan), {}), gain)
    out.mkdir(parents=True, exist_ok=True)
    protocol = write_record(made, repeats, out)
    for one in lessons:
        say(f"{one.name}: was off by {one.sideways_mm:.2f} mm in place, {one.depth_mm:.2f} mm in depth")
    say(str(protocol))
