"""The commands of analysis: one frozen request for each, and how a request becomes a command.

The options of a command are the annotated fields of its request, and its help is the request's docstring. Fields that
are not annotated are for callers in Python only. Nothing heavy is imported before a command runs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, field, fields
from importlib import import_module
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args, get_origin, get_type_hints

from typer import Argument, Option
from typer.core import TyperGroup

from brushloop.calibrate.errors import StrokesLeftOut
from brushloop.sessions.terminal import Progress, say, shown

Request = TypeVar("Request")


class Printable(Protocol):
    """The result of a command."""

    def lines(self) -> Iterable[object]:
        """What the command prints: lines and tables."""
        ...


Result = TypeVar("Result", bound=Printable)


def show_work(work: Callable[[Request, Progress], Result], request: Request) -> Result:
    """Do the work of a command, show its progress, and print and return its result."""
    with shown() as progress:
        result = work(request, progress)
    say(*result.lines())
    return result


def finish(work: Callable[[Request, Progress], Printable], request: Request) -> None:
    """Do `show_work`; then the result's `check`, if any, may raise, and `StrokesLeftOut` is raised if it names some."""
    result = show_work(work, request)
    getattr(result, "check", bool)()
    if left_out := getattr(result, "left_out", ()):
        raise StrokesLeftOut(f"finished, but strokes could not be used and were left out: {len(left_out)}")


def command(request: type[Any], work: str, carry_out: Callable[[Any, Any], object] = finish) -> Callable[..., None]:
    """A command that fills a request and carries out `work` on it, a function of brushloop as `module:name`."""

    def run(**options: Any) -> None:
        module, _, name = work.partition(":")
        values = {option: tuple(value) if option in repeated else value for option, value in options.items()}
        carry_out(getattr(import_module(f"brushloop.{module}"), name), request(**values))

    hints = get_type_hints(request, include_extras=True)
    parameters, repeated = list[Parameter](), set[str]()
    for each in fields(request):
        if get_origin(hints[each.name]) is Annotated:
            kind, option = get_args(hints[each.name])
            if get_origin(kind) is tuple and get_args(kind)[1:] == (...,):
                repeated.add(each.name)
                kind = list[get_args(kind)[0]]
            annotation = Annotated[kind, option]
            default = Parameter.empty if each.default is MISSING else each.default
            parameters.append(Parameter(each.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation))
    run.__doc__ = request.__doc__
    run.__signature__ = Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


class PathOrCommand(TyperGroup):
    """A group that runs its first command unless its first argument is the name of another one.

    `./diff` is then a path, `diff` the command of that name.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the first command's name before anything that is not a command's name."""
        first, *others = self.commands
        if not args and self.no_args_is_help:
            args = ["--help"]
        if not args or args[0] not in self.commands:

            def context(of: Any, info_name: str, parent: Any, **more: Any) -> Any:
                return type(ctx)(of, info_name=ctx.info_name, parent=ctx.parent, **more)

            command: Any = self.commands[first]
            command.epilog = f"Other commands, each with a --help of its own: {', '.join(others)}."
            # Its usage line shows what was typed: the name of the group.
            command.context_class, command.options_metavar = context, f"[{'|'.join(others)}] [OPTIONS]"
            args = [first, *args]
        return super().parse_args(ctx, args)


def _command_line() -> str:
    """The command that runs now, as a report names what made it."""
    return " ".join(["brushloop", *sys.argv[1:]])


Patch = Annotated[float, Option("--cell-mm", min=30, max=500, help="Side of each patch of paper.")]
Repeats = Annotated[int, Option(min=1, max=1000, help="How often each character is written.")]
Length = Annotated[float, Option(min=5, max=200, help="Length L of the brush.")]
CharacterData = Annotated[
    Path | None,
    Option(help="Folder with a file for each character, as 字.json, from github.com/chanind/hanzi-writer-data."),
]
PROTOCOL = "protocol-write.toml"
"""Name of the protocol in the folder of a plan."""
FIT = "Brush fit; the session's own by default. `published`, or a session without a fit: CCD-BSM as published."
PlanFile = Annotated[Path, Option(help="The plan's folder, or its plan.json.")]
Written = Annotated[Path, Argument(help="The session in which the plan's characters were written.")]


@dataclass(frozen=True, slots=True)
class AnalyseRequest:
    """Calibrate, fit and validate a session: from its photographs to the report, in one command."""

    session: Annotated[Path, Argument(help="A session's folder or its .mcap file.")]


@dataclass(frozen=True, slots=True)
class CalibrateRequest:
    """Fit scale and paper plane from the board in view; writes an immutable calibration/<hash>.json and its page."""

    session: Annotated[Path, Argument(help="A session's folder or its .mcap file.")]
    lens: Annotated[Path | None, Option(help="Lens file of `camera intrinsics`; the session's own by default.")] = None


@dataclass(frozen=True, slots=True)
class FitRequest:
    """Fit the stroke model to a session's presses; writes an immutable brushfit/<hash>.json and its page.

    For a session of drags it fits the lag of the bristles and writes dragfit/<hash>.json.
    """

    session: Annotated[Path, Argument(help="A session of presses, or of drags: its folder or its .mcap file.")]
    prior: Annotated[Path | None, Option(help="An earlier fit of drags with this brush, to be adapted.")] = None
    strokes: Annotated[
        int | None, Option(min=1, help="With --prior: number of strokes to adapt to, chosen to differ widely.")
    ] = None


@dataclass(frozen=True, slots=True)
class ValidateRequest:
    """Compare every model with every captured stroke; run the same command again to resume."""

    places: Annotated[tuple[Path, ...], Argument(metavar="SESSION", help="Sessions: folders or .mcap files.")]
    models: Annotated[tuple[str, ...], Option("--model", help="Only these models; all by default.")] = ()
    generators: Annotated[tuple[Path, ...], Option("--generator", help="Replaces the shipped generator.")] = ()
    fit: Annotated[Path | None, Option(help="Fit of the presses or drags; by default the one in use.")] = None
    out: Annotated[Path | None, Option(help="Folder of the report; <session>/validation by default.")] = None
    gates: Annotated[tuple[str, ...], Option("--gate", help="Least score, as 'csim_avg>=0.90'; exit 5 if missed.")] = ()
    ablations: Annotated[bool, Option("--ablations", help="Also try other lambdas, and fits to fewer presses.")] = False
    curves: Annotated[tuple[str, ...], Option(help="NAME=FOLDER of a training, for figures 9 and 12.")] = ()
    held_out: Annotated[bool, Option(help="Also predict each condition by a fit to all others.")] = True
    scheduler: Annotated[str, Option(help="An existing Dask cluster, as tcp://host:8786.")] = ""
    workers: Annotated[int | None, Option(min=1, max=1024, help="Number of threads; all cores by default.")] = None
    command: str = field(default_factory=_command_line)
    """Named by the report as what made it."""


@dataclass(frozen=True, slots=True)
class DiffRequest:
    """Show what got better or worse between two reports, sessions or software versions, by a paired test."""

    before: Annotated[Path, Argument(help="A report.json, or a session that was validated.")]
    after: Annotated[Path, Argument(help="A report.json or session to compare it with.")]


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """Export strokes, poses and forces: pictures as files, and tables as CSV or Parquet.

    Ends with exit code 3 if strokes could not be cropped; they are named.
    """

    session: Annotated[Path, Argument(help="A closed session's folder, or an .mcap file.")]
    out: Annotated[Path, Argument(help="Folder to create.")]
    kind: Annotated[str, Option("--format", help="How tables are written: csv or parquet.")] = "csv"
    crops: Annotated[bool, Option("--crops", help="Rectified crops (20 px/mm) and masks, no photographs.")] = False


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """Turn photographs and a table of what was pressed into a session that every later command accepts."""

    photographs: Annotated[Path, Argument(help="Folder of photographs, or the scan of a sheet of `camera sheet`.")]
    csv: Annotated[Path, Option(help="Table with a column `file` (or `box`), px_per_mm, and one for each parameter.")]
    out: Annotated[Path | None, Option(help="New session folder; sessions/<name of the photographs> by default.")] = (
        None
    )
    kind: Annotated[
        Literal["press", "drag"], Option(help="press (vertical presses) or drag (strokes along the paper).")
    ] = "press"
    px_per_mm: Annotated[float | None, Option(min=0.01, max=1e4, help="Scale, where the table has none.")] = None
    measured_mm: Annotated[
        tuple[float, float] | None, Option(help="A sheet's print, measured between its marks: mm across, mm along.")
    ] = None
    licence: Annotated[str, Option(help="Licence of the photographs, kept in the recording.")] = ""
    origin: Annotated[str, Option(help="Source of the photographs, kept in the recording.")] = ""
    brush: Annotated[str, Option(help="Description of the brush.")] = ""
    brush_radius_mm: Annotated[float, Option(min=0.5, max=50.0, help="Radius R of the brush, in mm.")] = 6.0
    brush_length_mm: Annotated[float, Option(min=5.0, max=500.0, help="Length L of the brush, in mm.")] = 48.0
    simulated: Annotated[bool, Option("--simulated", help="The ink was simulated; reports say so.")] = False


@dataclass(frozen=True, slots=True)
class RecoverRequest:
    """Recover depth and tilt of every captured press; writes a CSV and a protocol that presses them again."""

    session: Annotated[Path, Argument(help="A session's folder or its .mcap file; imports count as sessions.")]
    out: Annotated[Path, Option(help="CSV to write; protocol-replay.toml is put beside it.")] = Path("recovered.csv")
    fit: Annotated[Path | None, Option(help=FIT)] = None
    depth_range_mm: tuple[float, float] = (2.0, 30.0)
    tilt_range_deg: tuple[float, float] = (0.0, 30.0)
    presses: int | None = None
    """Only this many, spread evenly over the session."""
    seed: int = 1
    """Seed of the order in which the protocol presses them."""


@dataclass(frozen=True, slots=True)
class CompareLoopRequest:
    """Compare re-pressed strokes with their originals, and with the brush's own repeatability."""

    original: Annotated[Path, Argument(help="The session whose strokes were pressed again.")]
    again: Annotated[Path, Argument(help="The session that pressed them again.")]
    fit: Annotated[Path | None, Option(help=FIT)] = None
    out: Annotated[Path, Option(help="Folder for loop.html, loop.csv, loop.json.")] = Path("loop")
    command: str = field(default_factory=_command_line)


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Plan characters: depth follows each stroke's width, heading its path; then refine until the image matches."""

    what: Annotated[str, Argument(help="Characters; 字 子 永 are shipped.")]
    out: Annotated[Path, Option(help=f"Folder for {PROTOCOL} and plan.png.")] = Path("write-plan")
    data: CharacterData = None
    radius_mm: Annotated[float, Option(min=0.5, max=50, help="Radius R of the brush.")] = 6.0
    length_mm: Length = 48.0
    footprint: Annotated[
        Path | None, Option(help="Result of `write fit`: the plan is then made for the footprint of this brush.")
    ] = None
    cell_mm: Patch = 70.0
    depth_range_mm: Annotated[tuple[float, float], Option("--depth-range", help="Least and greatest depth, mm.")] = (
        0.5,
        20.0,
    )
    tilt_range_deg: Annotated[
        tuple[float, float], Option("--tilt-range", help="Least and greatest tilt, deg; at most 30.")
    ] = (0.0, 10.0)
    speed_mm_s: Annotated[float, Option(min=1, max=100, help="Speed of the tip.")] = 15.0
    wrist_deg_s: Annotated[float, Option(min=1, max=720, help="Greatest speed of the wrist.")] = 180.0
    steps: Annotated[int, Option(min=0, max=1000, help="Steps of refinement; 0 keeps the first plan.")] = 60
    repeats: Repeats = 1


@dataclass(frozen=True, slots=True)
class PracticeRequest:
    """Plan a practice sheet: strokes from which `write fit` learns how this brush is dragged.

    The strokes go no deeper than 0.3 times the brush's length.
    """

    out: Annotated[Path, Option(help=f"Folder for {PROTOCOL}.")] = Path("practice")
    radius_mm: float = 6.0
    length_mm: Length = 48.0
    cell_mm: Patch = 70.0


@dataclass(frozen=True, slots=True)
class FitFootprintRequest:
    """Fit the footprint of the dragged brush, for `write plan --footprint`."""

    session: Annotated[Path, Argument(help="A calibrated session of a practice sheet or of written characters.")]


@dataclass(frozen=True, slots=True)
class LearnRequest:
    """Make the next plan from the ink that this plan left, phase by phase of each stroke."""

    session: Written
    plan: PlanFile
    out: Annotated[Path, Option(help="Folder for the next plan.")]
    repeats: Repeats = 1
    settled_repeats: int | None = None
    """The same, used once every character is settled."""


@dataclass(frozen=True, slots=True)
class CompareWrittenRequest:
    """Compare written characters with the simulated image and with the reference, in both polarities (Table 3)."""

    session: Written
    plan: PlanFile
    out: Annotated[Path, Option(help="Folder for written.html, .csv, .json and figure-13.png.")] = Path("written")
    command: str = field(default_factory=_command_line)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardOptions:
    """A board: a checkerboard or a ChArUco board."""

    checkerboard: Annotated[str, Option(help="Inner corners of a checkerboard, as 9x6.")] = ""
    charuco: Annotated[str, Option(help="Squares of a ChArUco board, as 26x20.")] = ""
    square_mm: Annotated[float, Option(min=0.5, max=1000.0, help="Side of a square, measured on the print.")] = 12.0
    marker_mm: Annotated[float, Option(min=0, max=1000, help="Side of a marker; 0 for 0.75 of a square.")] = 0.0
    dictionary: Annotated[str, Option(help="ArUco dictionary of the markers.")] = "DICT_5X5_1000"


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintRequest(BoardOptions):
    """Write a printable board as a PDF at true scale."""

    out: Annotated[Path, Argument(help="PDF to create.")]
    page: Annotated[str, Option(help="Size of the page: a4, a3, a2 or letter.")] = "a4"


@dataclass(frozen=True, slots=True)
class SheetRequest:
    """Write a printable sheet with numbered boxes for presses made by hand, and the table to fill in beside it."""

    out: Annotated[Path, Argument(help="PDF to create; the table has the same name and ends in .csv.")]
    page: Annotated[str, Option(help="Size of the page: a4, letter or a3.")] = "a4"


@dataclass(frozen=True, slots=True, kw_only=True)
class LensRequest(BoardOptions):
    """Fit the lens, and say what each photograph contributes, which ones were dropped, and what is still missing."""

    photographs: Annotated[tuple[Path, ...], Argument(help="Photographs of one board, held at many angles.")]
    out: Annotated[Path, Option(help="Folder for the lens file.")] = Path("camera")


@dataclass(frozen=True, slots=True)
class TrainRequest:
    """Train the neural stroke generator on exact images of CCD-BSM (Algorithm 1), in one process on one device."""

    out: Annotated[Path, Option(help="Folder of this training; the same command resumes it.")] = Path("generator")
    target: Annotated[str, Option(help="Kind of image: press (centred) or anchored (at the point of touch).")] = "press"
    config: Annotated[Path | None, Option(help="A train.toml, used instead of the defaults of --target.")] = None


@dataclass(frozen=True, slots=True)
class TuneRequest:
    """Fine-tune a generator on captured presses; a share of their conditions is held out to validate on."""

    generator: Annotated[Path, Argument(help="The generator.safetensors to start from.")]
    sessions: Annotated[tuple[Path, ...], Argument(metavar="SESSION", help="Sessions of presses.")]
    out: Annotated[Path, Option(help="Folder of this training.")] = Path("generator-tuned")
    steps: Annotated[int, Option(min=1, help="Number of training steps.")] = 300
    learning_rate: Annotated[float, Option(min=0, max=1, help="Peak learning rate.")] = 3e-4


@dataclass(frozen=True, slots=True)
class TwinRequest:
    """Fit the simulator's brush, ink and camera noise to a session's presses; writes twin.toml.

    `brushloop sim --brush twin.toml` is then a rig that presses like that brush. A run that was interrupted continues
    when the same command is given again.
    """

    session: Annotated[Path, Argument(help="A session of presses: its folder or its .mcap file.")]
    out: Annotated[Path | None, Option(help="File to write; by default twin.toml in the session.")] = None
    replace: Annotated[bool, Option("--replace", help="Replace the file if it exists.")] = False
