"""`brushloop invert`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX


def invert(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file; imports count as sessions.")],
    out: Annotated[Path, typer.Option(help="CSV to write; protocol-replay.toml goes beside it.")] = Path(
        "recovered.csv"
    ),
    model: Annotated[str, typer.Option(help="The stroke model to invert.")] = "ccd-bsm",
    fit: Annotated[Path | None, typer.Option(help="A brush fitted to captures, instead of --model.")] = None,
    lam: Annotated[float | None, typer.Option(min=0.1, max=10, help="lambda of CCD-BSM; pi when left out.")] = None,
    depth_range: Annotated[tuple[float, float], typer.Option(help="Depths to look for, mm.")] = (2.0, 30.0),
    tilt_range: Annotated[tuple[float, float], typer.Option(help="Tilts to look for, deg; at most 30.")] = (0.0, 30.0),
    anchor_sd: Annotated[float, typer.Option(min=0, max=5, help="Standard deviation of the touch point, mm.")] = 0.1,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    calibration: Annotated[Path | None, typer.Option(help="Artefact; the one in use by default.")] = None,
    presses: Annotated[
        int | None, typer.Option(min=1, help="Only this many presses, spread evenly over the session.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How many times the protocol presses each stroke.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the order in which the protocol presses.")] = 1,
) -> None:
    """Recover depth and tilt of every captured press; writes a CSV and a protocol that presses them again."""

    from brushloop.calibrate.files import check_target
    from brushloop.sessions.recording import Recording

    check_target(out, ".csv")
    Recording(session)  # a wrong path is refused before the models are loaded, which takes seconds

    from brushloop.calibrate.invert.command import RecoverRequest, recover
    from brushloop.sessions.terminal import show_work

    request = RecoverRequest(
        session=session,
        out=out,
        model=model,
        fit=fit,
        lam=lam,
        depth_range_mm=depth_range,
        tilt_range_deg=tilt_range,
        anchor_sd_mm=anchor_sd,
        mm_per_px=mm_per_px,
        calibration=calibration,
        presses=presses,
        repeats=repeats,
        seed=seed,
    )
    show_work(recover, request)
