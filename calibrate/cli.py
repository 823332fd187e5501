"""`brushloop calibrate`, `camera`, `fit`, `invert`, `loop compare`, `sessions export`, `train`, and stages of `write`.

Heavy imports wait until a command runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from brushloop.calibrate.board.spec import Board
    from brushloop.model.generator.config import TrainConfig
    from brushloop.model.generator.data import TuningFiles

LEFT_OUT = 3
"""Exit code of an export that left strokes out."""


class PathOrCommand(TyperGroup):
    """A group that runs its first command unless its first argument is the name of another one.

    `./diff` is then a path, `diff` the command of that name.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the first command's name before anything that is not a command's name."""
        if not args or (args[0] not in self.commands and args[0] != "--help"):
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)


def calibrate(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file.")],
    lens: Annotated[
        Path | None, typer.Option(help="Lens file of `camera intrinsics`; the session's own by default.")
    ] = None,
) -> None:
    """Fit scale and paper plane from the board in view; writes an immutable calibration/<hash>.json and its page."""
    from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session
    from brushloop.sessions.terminal import show_work

    show_work(calibrate_session, CalibrateRequest(session, lens))


def fit(
    session: Annotated[Path, typer.Argument(help="A session of presses: its folder or its .mcap file.")],
    mm_per_px: Annotated[
        float | None,
        typer.Option(min=0.1, max=1.0, help=f"Scale of the images; {MM_PER_PX:g}, with --drags 0.4."),
    ] = None,
    drags: Annotated[
        bool, typer.Option("--drags", help="Fit bristle lag to drags; writes dragfit/<hash>.json.")
    ] = False,
    prior: Annotated[
        Path | None, typer.Option(help="With --drags: a dragfit of this brush, whose place and width are adapted.")
    ] = None,
    strokes: Annotated[
        int | None, typer.Option(min=1, help="With --prior: only this many strokes, as different as possible.")
    ] = None,
) -> None:
    """Fit the stroke model to a session's presses; writes an immutable brushfit/<hash>.json and its page."""
    if (prior is not None and not drags) or (strokes is not None and prior is None):
        raise typer.BadParameter("--prior needs --drags, and --strokes needs --prior")
    if drags:
        _fit_drags(session, mm_per_px, prior, strokes)
        return

    from brushloop.calibrate.fit.fit import FitRequest, fit_presses
    from brushloop.sessions.terminal import show_work

    show_work(fit_presses, FitRequest(session, mm_per_px or MM_PER_PX))


def _fit_drags(session: Path, mm_per_px: float | None, prior: Path | None, strokes: int | None) -> None:
    from brushloop.calibrate.artefact import load_artefact, put_to_use
    from brushloop.calibrate.drags import MM_PER_PX, read_drags
    from brushloop.calibrate.drags.fit import FOLDER, DragArtefact, adapt_drags, fit_drags
    from brushloop.calibrate.drags.report import fit_lines
    from brushloop.sessions.terminal import shown

    before = load_artefact(prior, DragArtefact) if prior is not None else None
    with shown() as progress:
        drags = read_drags(session, mm_per_px or (before.mm_per_px if before is not None else MM_PER_PX), progress)
        if before is not None:
            artefact = adapt_drags(drags, before, str(prior), strokes or len(drags.placed))
        else:
            artefact = fit_drags(drags, progress)
    say(*fit_lines(drags, artefact), f"Fit: {put_to_use(artefact, drags.session.recording.path.parent, FOLDER)}")


def export(
    session: Annotated[Path, typer.Argument(help="A closed session's folder, or an .mcap file.")],
    out: Annotated[Path, typer.Argument(help="The new folder.")],
    kind: Annotated[str, typer.Option("--format", help="How tables are written: csv or parquet.")] = "csv",
    crops: Annotated[
        bool, typer.Option("--crops", help="Rectified crops at 20 px/mm with masks, instead of photographs.")
    ] = False,
) -> None:
    """Export strokes, poses and forces: pictures as files, and tables as CSV or Parquet.

    Ends with exit code 3 if strokes could not be cropped; they are named.
    """
    from brushloop.calibrate.export import export as write
    from brushloop.sessions.terminal import shown

    with shown() as progress:
        left_out = write(session, out, kind, progress, crops=crops)
    say(f"Exported into {out}")
    for stroke_id, reason in left_out:
        say(f"left out: {stroke_id}: {reason}", err=True)
    if left_out:
        raise typer.Exit(LEFT_OUT)


def invert(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file; imports count as sessions.")],
    out: Annotated[Path, typer.Option(help="CSV to write; protocol-replay.toml goes beside it.")] = Path(
        "recovered.csv"
    ),
    fit: Annotated[Path | None, typer.Option(help="A brush fitted to captures; else CCD-BSM as published.")] = None,
) -> None:
    """Recover depth and tilt of every captured press; writes a CSV and a protocol that presses them again."""
    from brushloop.calibrate.files import check_target
    from brushloop.sessions.recording import Recording

    check_target(out, ".csv")
    Recording(session)  # a wrong path is refused before the models are loaded, which takes seconds

    from brushloop.calibrate.invert import RecoverRequest, recover
    from brushloop.sessions.terminal import show_work

    show_work(recover, RecoverRequest(session, out, fit=fit))


def compare_loop(
    original: Annotated[Path, typer.Argument(help="The session whose strokes were pressed again.")],
    again: Annotated[Path, typer.Argument(help="The session of the replay protocol.")],
    fit: Annotated[
        Path | None, typer.Option(help="Brush fit that recovered depth and tilt; else CCD-BSM as published.")
    ] = None,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    out: Annotated[Path, typer.Option(help="Folder for loop.html, loop.csv, loop.json.")] = Path("loop"),
) -> None:
    """Compare re-pressed strokes with their originals, and with the brush's own repeatability."""
    import sys

    from brushloop.calibrate.loop import CompareRequest
    from brushloop.calibrate.loop import compare as run
    from brushloop.sessions.terminal import show_work

    show_work(run, CompareRequest(original, again, out, " ".join(["brushloop", *sys.argv[1:]]), fit, mm_per_px))


def write_plan(
    what: Annotated[str, typer.Argument(help="Characters (字 子 永 are shipped), or a .csv trajectory.")],
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml and plan.png.")] = Path("write-plan"),
    data: Annotated[Path | None, typer.Option(help="Folder of hanzi-writer files, such as 字.json.")] = None,
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
    from brushloop.calibrate.writing import PlannedBy
    from brushloop.calibrate.writing.plan import PlanRequest
    from brushloop.calibrate.writing.plan import plan as run
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


def write_compare(
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


def write_learn(
    session: Annotated[Path, typer.Argument(help="The session in which a plan was written.")],
    plan: Annotated[Path, typer.Option(help="The plan's folder, or its plan.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the next plan.")],
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written next.")] = 1,
) -> None:
    """Make the next plan from what the ink of this one showed, phase by phase."""
    from brushloop.calibrate.writing.learn import LearnRequest
    from brushloop.calibrate.writing.learn import learn as run
    from brushloop.sessions.terminal import show_work

    show_work(run, LearnRequest(session, plan, out, repeats))


def write_practice(
    out: Annotated[Path, typer.Option(help="Folder for protocol-write.toml.")] = Path("practice"),
    length_mm: Annotated[
        float, typer.Option(min=5, max=200, help="Length L of the brush; strokes go no deeper than 0.3 of it.")
    ] = 48.0,
    cell_mm: Annotated[float, typer.Option(min=30, max=500, help="Side of each patch of paper.")] = 70.0,
) -> None:
    """Plan a practice sheet: strokes from which `write fit` learns how this brush is dragged."""
    from brushloop.calibrate.writing import PlannedBy
    from brushloop.calibrate.writing.learn import PracticeRequest
    from brushloop.calibrate.writing.learn import practice as run
    from brushloop.sessions.terminal import show_work

    show_work(run, PracticeRequest(out, PlannedBy(length_mm=length_mm), cell_mm))


def write_fit(
    session: Annotated[Path, typer.Argument(help="A calibrated session of a practice sheet, or of any figures.")],
) -> None:
    """Fit the footprint of the dragged brush, for `write plan --footprint`."""
    from brushloop.calibrate.writing.learn import fit as run
    from brushloop.sessions.terminal import show_work

    show_work(run, session)


camera = typer.Typer(help="Print a board, and calibrate the lens by photographs of it.", no_args_is_help=True)

Corners = Annotated[str, typer.Option("--checkerboard", help="Inner corners of a checkerboard, as 9x6.")]
Squares = Annotated[str, typer.Option("--charuco", help="Squares of a ChArUco board, as 26x20.")]
Square = Annotated[float, typer.Option(min=0.5, max=1000.0, help="Side of a square, measured on the print.")]
Marker = Annotated[float, typer.Option(min=0.0, max=1000.0, help="Side of a marker; 0: three quarters of a square.")]
Dictionary = Annotated[str, typer.Option(help="Markers of the ChArUco board.")]


@camera.command("board")
def print_board(
    out: Annotated[Path, typer.Argument(help="The new PDF.")],
    checkerboard: Corners = "",
    charuco: Squares = "",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    page: Annotated[str, typer.Option(help="a4, a3, a2 or letter.")] = "a4",
) -> None:
    """Write a printable board as a PDF at true scale."""
    from brushloop.calibrate.board.spec import describe, write_pdf

    board = _board(checkerboard, charuco, square_mm, marker_mm, dictionary)
    say(f"{write_pdf(board, out, page)}: {describe(board)}")


@camera.command()
def intrinsics(
    photographs: Annotated[list[Path], typer.Argument(help="Photographs of one board, held in many ways.")],
    checkerboard: Corners = "",
    charuco: Squares = "",
    square_mm: Square = 12.0,
    marker_mm: Marker = 0.0,
    dictionary: Dictionary = "DICT_5X5_1000",
    out: Annotated[Path, typer.Option(help="Folder for the lens file.")] = Path("camera"),
) -> None:
    """Fit the lens, and say what each photograph contributes, which were dropped, and what else to photograph."""
    import hashlib

    from brushloop.calibrate.board.detect import find_board
    from brushloop.calibrate.board.lens import fit_lens
    from brushloop.calibrate.board.spec import BoardView, describe
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import MAX_PHOTOGRAPH_BYTES, read_bounded, read_gray
    from brushloop.sessions.terminal import counted, shown

    board = _board(checkerboard, charuco, square_mm, marker_mm, dictionary)
    seen, unusable, digests = list[BoardView](), dict[str, str](), dict[str, str]()
    with shown() as progress:
        for path in counted(photographs, "photographs searched for the board", len(photographs), progress):
            image = read_gray(path)
            digests[str(path)] = hashlib.sha256(read_bounded(path, MAX_PHOTOGRAPH_BYTES)).hexdigest()
            try:
                seen.append(find_board(image, board, str(path)))
            except CalibrationError as error:
                unusable[str(path)] = error.what
    lens = fit_lens(seen, describe(board), digests, unusable)
    say(*lens.lines(), str(lens.save(out)))


def _board(checkerboard: str, charuco: str, square_mm: float, marker_mm: float, dictionary: str) -> Board:
    from pydantic import ValidationError

    from brushloop.calibrate.board.spec import BoardSpec, Checkerboard
    from brushloop.calibrate.errors import CalibrationError, invalid

    if bool(checkerboard) == bool(charuco):
        raise CalibrationError(
            "board", "give one of --checkerboard (inner corners) and --charuco (squares), such as 9x6"
        )
    size = (checkerboard or charuco).lower().split("x")
    try:
        if checkerboard:
            return Checkerboard.model_validate({"inner_corners": size, "square_mm": square_mm})
        marker = {"marker_mm": marker_mm or 0.75 * square_mm, "dictionary": dictionary, "origin_mm": (0.0, 0.0)}
        return BoardSpec.model_validate({"squares": size, "square_mm": square_mm} | marker)
    except ValidationError as error:
        raise invalid("board", error) from None


train = typer.Typer(help="Train the neural stroke generator, or tune it on captures.")


@train.callback(invoke_without_command=True)
def train_generator(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of this training; the same command resumes it.")] = Path(
        "generator"
    ),
    target: Annotated[str, typer.Option(help="press or anchored.")] = "press",
    config: Annotated[Path | None, typer.Option(help="A train.toml instead of a target's defaults.")] = None,
) -> None:
    """Train on exact images of CCD-BSM (Algorithm 1), in one process on one device."""
    if context.invoked_subcommand is None:
        from brushloop.model.generator.config import load_config, preset

        _train(preset(target) if config is None else load_config(config), out)


@train.command()
def tune(
    generator: Annotated[Path, typer.Argument(help="The generator.safetensors to start from.")],
    captures: Annotated[Path, typer.Argument(help="Captured strokes, a safetensors file.")],
    out: Annotated[Path, typer.Option(help="Folder of this training.")] = Path("generator-tuned"),
    steps: Annotated[int, typer.Option(min=1, help="Number of steps.")] = 300,
    learning_rate: Annotated[float, typer.Option(min=0, max=1, help="Peak learning rate.")] = 3e-4,
    held_out: Annotated[float, typer.Option(min=0, max=1, help="Share of conditions to validate on.")] = 0.2,
) -> None:
    """Fine-tune a generator on captured strokes; some are held out to validate on."""
    from brushloop.model.generator.data import TuningFiles

    files = TuningFiles(generator, captures)
    every = max(1, steps // 20)
    _train(files.config(held_out, steps=steps, learning_rate=learning_rate, validate_every=every), out, files)


def _train(config: TrainConfig, folder: Path, tuning: TuningFiles | None = None) -> None:
    """Train in the folder, and write the generator's card and the page."""
    from brushloop.calibrate.training import write_training
    from brushloop.model.generator.train import run_training
    from brushloop.sessions.terminal import shown

    with shown() as progress:
        progress("training", 0, config.steps)
        path = run_training(config, folder, lambda step: progress("training", step, config.steps), tuning)
    say(f"Generator: {path}, its card: {path.with_suffix('.md')}", f"Page: {write_training(path, tuning)}")
