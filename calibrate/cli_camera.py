"""`brushloop camera ...`: board, lens, plane, drift, registration. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from brushloop.calibrate.board.spec import Board


app = typer.Typer(
    help="Calibrate the camera: board, lens, plane of the paper, registration of the robot.", no_args_is_help=True
)

Corners = Annotated[str, typer.Option("--checkerboard", help="Inner corners of a checkerboard, as 9x6.")]
Squares = Annotated[str, typer.Option("--charuco", help="Squares of a ChArUco board, as 26x20.")]
Square = Annotated[float, typer.Option(min=0.5, max=1000.0, help="Side of a square, measured on the print.")]
Marker = Annotated[float, typer.Option(min=0.0, max=1000.0, help="Side of a marker; 0: three quarters of a square.")]
Dictionary = Annotated[str, typer.Option(help="Markers of the ChArUco board.")]
LensOption = Annotated[Path | None, typer.Option("--lens", help="Lens file of `camera intrinsics`.")]


@app.command()
def board(
    out: Annotated[Path, typer.Argument(help="The new PDF.")],
    checkerboard: Corners = "",
    charuco: Squares = "",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    page: Annotated[str, typer.Option(help="a4, a3, a2 or letter.")] = "a4",
) -> None:
    """Write a printable board as a PDF at true scale, with a ruler to check the print."""
    from brushloop.calibrate.board.spec import describe, write_pdf

    target = _board(checkerboard, charuco, square_mm, marker_mm, dictionary)
    say(f"{write_pdf(target, out, page)}: {describe(target)}")


@app.command()
def intrinsics(
    photographs: Annotated[list[Path], typer.Argument(help="Photographs of one board, held in many ways.")],
    checkerboard: Corners = "",
    charuco: Squares = "",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    limit_px: Annotated[float, typer.Option(min=0.01, max=10.0, help="Residual above which it warns.")] = 0.5,
    out: Annotated[Path, typer.Option(help="Folder for the lens file.")] = Path("camera"),
) -> None:
    """Fit the lens, and say what each photograph contributes, which were dropped, and what else to photograph."""
    import hashlib

    from brushloop.calibrate.board.detect import BoardView, find_board
    from brushloop.calibrate.board.intrinsics import fit_lens, named
    from brushloop.calibrate.board.spec import describe
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import MAX_PHOTOGRAPH_BYTES, read_bounded, read_gray
    from brushloop.calibrate.pages.camera import MAX_THUMBNAILS, Thumbnail, thumbnail, write_lens_page
    from brushloop.sessions.terminal import counted, shown

    target = _board(checkerboard, charuco, square_mm, marker_mm, dictionary)
    seen, unusable, digests = list[BoardView](), dict[str, str](), dict[str, str]()
    small = dict[str, Thumbnail]()
    paths = named(photographs)
    with shown() as progress:
        for name, path in counted(paths.items(), "photographs searched for the board", len(paths), progress):
            image = read_gray(path)
            if len(small) < MAX_THUMBNAILS:
                small[name] = thumbnail(image)
            digests[name] = hashlib.sha256(read_bounded(path, MAX_PHOTOGRAPH_BYTES)).hexdigest()
            try:
                seen.append(find_board(image, target, name))
            except CalibrationError as error:
                unusable[name] = error.what
    file = fit_lens(seen, describe(target), digests, unusable, limit_px)
    for name, residual in file.residuals_px.items():
        say(f"{name}: {residual:.3f} px, slanted by {file.slants_deg[name]:.0f} deg")
    for name, residual in file.dropped.items():
        say(f"{name}: {residual:.3f} px, dropped: it does not fit the others")
    for name, why in file.unusable.items():
        say(f"{name}: {why}")
    fx, fy, cx, cy = file.lens.matrix
    reach = file.focal_reach_px
    across, along = ("", "") if reach is None else (f" +- {reach[0]:.2f}", f" +- {reach[1]:.2f}")
    say(
        f"fx {fx:.2f}{across} px, fy {fy:.2f}{along} px{'' if reach is None else ' (95 %)'}, "
        f"centre {cx:.1f}, {cy:.1f} px, k1 {file.lens.distortion[0]:+.4f}",
        f"residual {file.rms_px:.3f} px over {len(file.residuals_px)} views, the board held in {file.ways} ways",
    )
    for line in (*(f"warning: {w}" for w in file.warnings), *(f"to do: {g}" for g in file.guidance)):
        say(line)
    path = file.save(out)
    say(str(path), f"Page: {write_lens_page(path, file, seen, small)}")


@app.command()
def check(
    photograph: Annotated[Path, typer.Argument(help="A photograph of the board as it will lie, no sheet on it.")],
    charuco: Squares = "26x20",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    lens: LensOption = None,
    limit_px: Annotated[float, typer.Option(min=0.01, max=10.0, help="Residual above which it warns.")] = 0.5,
) -> None:
    """Measure pix2len with its interval on one photograph of the board before a session. Exit code 5 on warnings."""
    from brushloop.calibrate.artefact import load_artefact
    from brushloop.calibrate.board.intrinsics import LensFile
    from brushloop.calibrate.board.spec import BoardSpec
    from brushloop.calibrate.board.view import preflight
    from brushloop.calibrate.files import read_gray

    spec = _board("", charuco, square_mm, marker_mm, dictionary)
    assert isinstance(spec, BoardSpec)
    plane, warnings = preflight(read_gray(photograph), spec, load_artefact(lens, LensFile) if lens else None, limit_px)
    low, high = plane.interval_mm_per_px
    say(
        f"pix2len {plane.mm_per_px:.5f} mm/px (95 %: {low:.5f} to {high:.5f}), residual {plane.rms_px:.3f} px over "
        f"{plane.corners} corners, k1 {plane.lens.distortion[0]:+.4f}"
    )
    for warning in warnings:
        say(f"warning: {warning}")
    if warnings:
        raise typer.Exit(5)


@app.command()
def drift(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file.")],
    lens: LensOption = None,
) -> None:
    """Show pix2len at each view of the board in a session, and its trend. Exit code 5 on warnings."""
    from brushloop.calibrate.board.view import board_of, board_over_session, known_lens
    from brushloop.sessions.recording import Recording
    from brushloop.sessions.terminal import shown

    recording = Recording(session)
    known = known_lens(recording, lens)
    with shown() as progress:
        measured = board_over_session(recording, board_of(recording), known, progress)
    for seen in measured.seen:
        low, high = (seen.mm_per_px * (1.0 + side * seen.reach) for side in (-1.0, 1.0))
        after_s = (seen.t_ns - measured.seen[0].t_ns) / 1e9
        say(
            f"{after_s:8.0f} s: {seen.mm_per_px:.5f} mm/px (95 %: {low:.5f} to {high:.5f}), "
            f"residual {seen.plane.rms_px:.3f} px, board moved {seen.moved_px:.2f} px"
        )
    if measured.trend is not None:
        low, high = measured.trend.interval
        say(f"trend {100 * measured.trend.slope:+.4f} % per hour (95 %: {100 * low:+.4f} to {100 * high:+.4f})")
    for warning in measured.warnings:
        say(f"warning: {warning}")
    if measured.warnings:
        raise typer.Exit(5)


@app.command()
def register(
    table: Annotated[Path, typer.Argument(help="CSV with name, robot_x_mm, robot_y_mm, image_x_px, image_y_px.")],
    photograph: Annotated[Path, typer.Option(help="Photograph of the board, taken as the marks were.")],
    config: Annotated[Path | None, typer.Option(help="The rig.toml whose board and lens the photograph shows.")] = None,
    write: Annotated[
        Path | None, typer.Option(help="The rig.toml to write origin_mm and yaw_deg into; read as --config is.")
    ] = None,
    charuco: Squares = "26x20",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    origin_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Without a rig.toml: lower left corner of the board, seen from that of the sheet."),
    ] = None,
    lens: LensOption = None,
    out: Annotated[Path, typer.Option(help="Folder for the registration file.")] = Path("camera"),
) -> None:
    """Locate the paper in the robot's base frame from touched or pressed marks; prints the lines for rig.toml."""
    import hashlib

    from brushloop.calibrate.board.intrinsics import read_lens
    from brushloop.calibrate.board.register import read_points, read_rig, toml_lines
    from brushloop.calibrate.board.register import register as fit
    from brushloop.calibrate.board.spec import BoardSpec
    from brushloop.calibrate.board.view import calibration_plane
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import MAX_PHOTOGRAPH_BYTES, read_bounded, read_gray

    rig_path = config or write
    rig = read_rig(rig_path) if rig_path else None
    target = read_rig(write) if write else None
    if rig is not None:
        spec = rig.board
    elif origin_mm is not None:
        flat = _board("", charuco, square_mm, marker_mm, dictionary)
        assert isinstance(flat, BoardSpec)
        spec = flat.model_copy(update={"origin_mm": origin_mm})
    else:
        problem = "is not known: give --config rig.toml, or the board by its options and --origin-mm X Y"
        raise CalibrationError("where the sheet lies on the board", problem)
    points = read_points(table)
    lens = lens or (rig.lens_file if rig else None)
    known = read_lens(lens) if lens else None
    plane = calibration_plane(read_gray(photograph), spec, known, str(photograph))
    seen = hashlib.sha256(read_bounded(photograph, MAX_PHOTOGRAPH_BYTES)).hexdigest()
    through = known.source if known else "no lens"
    source = f"{table.name}, sha256 {points.sha256}; {photograph.name}, sha256 {seen}; {through}"
    fitted = fit(points.names, points.robot_mm, plane.to_paper(points.image_px), source, spec.origin_mm)
    for name, (dx, dy) in fitted.residuals_mm.items():
        say(f"{name}: {dx:+.3f}, {dy:+.3f} mm")
    for name, (dx, dy) in fitted.dropped.items():
        say(f"{name}: {dx:+.3f}, {dy:+.3f} mm, dropped: it does not fit the others")
    for flag in plane.flags:
        say(f"warning: {flag}")
    residual = f"residual {fitted.rms_mm:.3f} mm, {fitted.left_out_rms_mm:.3f} mm for a point that was left out"
    say(residual, str(fitted.save(out)))
    if target is not None:
        say(f"{target.path}: written; the old file is kept as {target.write(fitted.paper)}")
    else:
        say("for [paper] of rig.toml:")
    say(*toml_lines(fitted.paper))


def _board(checkerboard: str, charuco: str, square_mm: float, marker_mm: float, dictionary: str) -> Board:
    from pydantic import ValidationError

    from brushloop.calibrate.board.spec import BoardSpec, Checkerboard
    from brushloop.calibrate.errors import CalibrationError, invalid

    if bool(checkerboard) == bool(charuco):
        raise CalibrationError(
            "board", "give one of --checkerboard (inner corners) and --charuco (squares), such as 9x6"
        )
    try:
        if checkerboard:
            return Checkerboard(inner_corners=_pair(checkerboard), square_mm=square_mm)
        return BoardSpec(
            squares=_pair(charuco),
            square_mm=square_mm,
            marker_mm=marker_mm or 0.75 * square_mm,
            dictionary=dictionary,
            origin_mm=(0.0, 0.0),
        )
    except ValidationError as error:
        raise invalid("board", error) from None


def _pair(text: str) -> tuple[int, int]:
    from brushloop.calibrate.errors import CalibrationError

    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and len(part) < 4 for part in parts):
        raise CalibrationError("board", f"{text!r} is not a size such as 9x6")
    return int(parts[0]), int(parts[1])
