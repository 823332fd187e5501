"""The front door: one typer app that mounts the sub-commands and imports nothing heavy."""

from __future__ import annotations

import errno
import gc
import sys
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path
from traceback import format_exc
from typing import Annotated, Any, cast

import typer
from typer.core import TyperGroup

import brushloop.collect.cli
import brushloop.sessions.cli
from brushloop.calibrate import commands
from brushloop.calibrate.commands import PathOrCommand, command
from brushloop.collect import chains
from brushloop.sessions.terminal import plain, say

EXIT_CODES = {
    0: "done",
    1: "a defect: please report it with its traceback",
    2: "input or configuration cannot be used; nothing half-written is left",
    3: "finished, but strokes were left out, or a repair lost something",
    4: "stopped or aborted, also by a full disk, too little memory or a closed output; repeat the command to continue",
    5: "finished, but a required score was missed (`validate --gate`), or the rig's settings contradict each other",
    6: "a recording is damaged: try `brushloop sessions repair`",
    130: "interrupted by Ctrl-C (`collect` and `sim` instead shut down in order, with one of the codes above)",
}
"""What each exit code of every command means."""


class ArgumentRefused(Exception):
    """A number on the command line lies outside its range, or a name, or that of the working folder, is not UTF-8."""

    exit_code = 2


class OutputClosed(Exception):
    """Whoever read the output, such as `head`, has ended, so no message can be shown."""

    exit_code = 4


class FrontDoor(TyperGroup):
    """Reports the given number and both ends of its range; typer itself names only one end, and allows `nan`."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command. Raises `ArgumentRefused`, and `OutputClosed`, where typer itself would end with code 1."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise OutputClosed from None
        except typer.BadParameter as error:
            param, cause = error.param, error.__cause__
            ends = {word: getattr(param, name, None) for word, name in (("from", "min"), ("to", "max"))}
            allowed = " ".join(f"{word} {end:g}" for word, end in ends.items() if end is not None)
            if param is None or cause is None or not allowed:
                raise
            given = cast("Any", cause).errors()[0]["input"]  # pydantic's, which typer asks
            raise ArgumentRefused(f"{param.opts[-1]} is {given!r}, allowed: a number {allowed}") from None


app = typer.Typer(
    cls=FrontDoor,
    help="Press a Chinese brush with a robot arm, record it, and measure how well a stroke model predicts the ink.\n\n"
    "Without a command, on a terminal, it opens the operator's screen: new sessions, resuming, review.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        say(f"brushloop {version('brushloop')}")
        raise typer.Exit


def run_chain(chain: Callable[[Any], object], request: Any) -> None:
    """Carry out a command whose stages show their own progress and results."""
    chain(request)


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Take the options of brushloop itself."""


EVERY_DAY, SET_UP, RESEARCH, SIMULATOR = "Every day", "Set-up", "Research", "Simulator"
GROUPS = {
    "validate": (RESEARCH, "Compare every stroke model with every captured stroke (`brushloop validate SESSION...`)."),
    "repress": (RESEARCH, "Recover depth and tilt of a SESSION's presses, press them again, compare; or only compare."),
    "write": (RESEARCH, "Write characters on the rig and compare them with the wanted images; or do one step alone."),
    "train": (RESEARCH, "Train the neural stroke generator, or tune it on captures."),
    "sim": (SIMULATOR, "Serve the loopback rig, make its devices fail, or act as the person in a simulated lab."),
}
"""Groups whose first command runs where no other is named: where the help lists them, and its words."""
COMMANDS: tuple[tuple[str, str, type[Any], str], ...] = (
    ("analyse", EVERY_DAY, commands.AnalyseRequest, "calibrate.notebook:analyse"),
    ("calibrate", RESEARCH, commands.CalibrateRequest, "calibrate.calibrated:calibrate_session"),
    ("camera board", "", commands.PrintRequest, "calibrate.board.spec:print_board"),
    ("camera sheet", "", commands.SheetRequest, "calibrate.board.sheet:print_sheet"),
    ("camera intrinsics", "", commands.LensRequest, "calibrate.calibrated:calibrate_lens"),
    ("fit", RESEARCH, commands.FitRequest, "calibrate.fit.command:fit"),
    ("recover", RESEARCH, commands.RecoverRequest, "calibrate.recover:recover"),
    ("repress compare", "", commands.CompareLoopRequest, "calibrate.loop:compare"),
    ("sessions import", "", commands.ImportRequest, "calibrate.imports:import_session"),
    ("sessions export", "", commands.ExportRequest, "calibrate.export:export"),
    ("train generator", "", commands.TrainRequest, "calibrate.training:train"),
    ("train tune", "", commands.TuneRequest, "calibrate.training:tune"),
    ("twin", RESEARCH, commands.TwinRequest, "twin.run:twin"),
    ("validate sessions", "", commands.ValidateRequest, "calibrate.validate.command:validate"),
    ("validate diff", "", commands.DiffRequest, "calibrate.validate.command:compare"),
    ("write plan", "", commands.PlanRequest, "calibrate.writing:plan"),
    ("write compare", "", commands.CompareWrittenRequest, "calibrate.writing.compare:compare"),
    ("write learn", "", commands.LearnRequest, "calibrate.writing.learn:learn"),
    ("write practice", "", commands.PracticeRequest, "calibrate.writing.learn:practice"),
    ("write fit", "", commands.FitFootprintRequest, "calibrate.writing.learn:fit"),
)
"""Commands of analysis: name, where the help lists it, what it takes, and the function that does it."""

camera = typer.Typer(
    help="Print a board or a sheet, and calibrate the lens by photographs of the board.", no_args_is_help=True
)
groups = {"sessions": brushloop.sessions.cli.app, "camera": camera}
app.add_typer(brushloop.collect.cli.app, name="collect", rich_help_panel=EVERY_DAY)
app.add_typer(groups["sessions"], name="sessions", rich_help_panel=EVERY_DAY)
app.command("doctor", rich_help_panel=EVERY_DAY)(brushloop.collect.cli.doctor)
app.add_typer(brushloop.collect.cli.rig_app, name="rig", rich_help_panel=SET_UP)
app.add_typer(camera, name="camera", rich_help_panel=SET_UP)
for name, (panel, words) in GROUPS.items():
    groups[name] = typer.Typer(cls=PathOrCommand, help=words, no_args_is_help=name == "train")
    app.add_typer(groups[name], name=name, rich_help_panel=panel)
groups["repress"].command("session")(command(chains.LoopRequest, "collect.chains.loop:run_loop", run_chain))
groups["write"].command("characters")(command(chains.WritingRequest, "collect.chains.writing:write", run_chain))
demo = command(chains.DemoRequest, "collect.chains.demo:demo", run_chain)
app.command("demo", rich_help_panel=EVERY_DAY)(demo)
for name, panel, request, work in COMMANDS:
    *group, last = name.split()
    parent = groups[group[0]] if group else app
    parent.command(last, rich_help_panel=panel or None)(command(request, work))


@groups["sim"].command("serve")
def sim(
    write_rig: Annotated[Path | None, typer.Option(help="Write the rig.toml of this rig here.")] = None,
    rate: Annotated[float, typer.Option(min=0.01, max=1000, help="Simulated seconds per real second.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of brush, presses and noise.")] = 1,
    fps: Annotated[float, typer.Option(min=1, max=60, help="Camera pictures per real second.")] = 8.0,
    idle_exit: Annotated[float, typer.Option(min=0, help="Seconds without a client until the end; 0: never.")] = 0.0,
    brush: Annotated[
        Path, typer.Option(help="A shipped brush, `loopback` or `table2`, or one described in a brush.toml.")
    ] = Path("loopback"),
    control: Annotated[Path | None, typer.Option(help="Control socket to make for `sim fault` and `sim hand`.")] = None,
    unknown: Annotated[
        int | None, typer.Option(min=0, help="Serve a simulated lab whose unknown dimensions are drawn from this seed.")
    ] = None,
    trap: Annotated[str | None, typer.Option(help="What is wrong in the unknown lab, such as swapped-corner.")] = None,
) -> None:
    """Serve the loopback rig: an ARCS controller and an MJPEG camera over one simulated world, on 127.0.0.1 only.

    Ctrl-C ends it; SIGUSR1 puts a fresh sheet in. An unknown lab has a loopback address of its own and no rig.toml,
    which `brushloop rig new` has to find out.
    """
    import asyncio

    from brushloop.drivers.loopback import RigRefused
    from brushloop.drivers.sim.brush.brush_file import load_brush
    from brushloop.drivers.sim.config import SimConfig, View
    from brushloop.drivers.sim.rig import LoopbackRig, serve

    if unknown is not None:
        from brushloop.drivers.sim.lab import UnknownLab

        if write_rig is not None or brush != Path("loopback"):
            raise RigRefused("--unknown: can only be combined with --trap, --control, --rate and --idle-exit")
        asyncio.run(serve(UnknownLab(unknown, trap, rate=rate), say, idle_exit_s=idle_exit, control=control))
        return
    if trap is not None:
        raise RigRefused("--trap: needs --unknown SEED")
    pressed = load_brush(brush, seed)
    config = SimConfig(
        seed=seed,
        rate=rate,
        brush=pressed.brush,
        misfit=pressed.misfit,
        brush_name=pressed.name,
        head=pressed.quality,
        view=View(fps=fps) if pressed.camera is None else View(fps=fps, noise=pressed.camera.noise),
    )
    asyncio.run(serve(LoopbackRig(config), say, write_rig=write_rig, idle_exit_s=idle_exit, control=control))


@groups["sim"].command()
def fault(
    control: Annotated[Path, typer.Argument(help="Control socket of a rig, made by `brushloop sim --control PATH`.")],
    what: Annotated[str, typer.Argument(help="Device to break; or list, clear, state, release or fresh-sheet.")],
    kind: Annotated[
        str | None,
        typer.Argument(help="Kind of fault, such as mute, late, black or bus-off (docs/loopback-controller.md)."),
    ] = None,
    on: Annotated[str | None, typer.Option(help="Fail only in calls of this robot method, such as moveLine.")] = None,
    nth: Annotated[int | None, typer.Option(help="Let the fault begin at the n-th request, pose or frame.")] = None,
    phase: Annotated[str | None, typer.Option(help="Begin while the arm does this, such as descending.")] = None,
    press: Annotated[int | None, typer.Option(help="Begin while this many presses are on the paper.")] = None,
    count: Annotated[int | None, typer.Option(help="Occur this many times.")] = None,
    for_s: Annotated[float | None, typer.Option(help="Last for this many real seconds.")] = None,
    late_s: Annotated[float | None, typer.Option(help="Delay of a late reply, in real seconds.")] = None,
    ident: Annotated[int | None, typer.Option("--id", help="Number of the fault to clear; all by default.")] = None,
) -> None:
    """Break a device of a running loopback rig, list its faults, or act as the person at its pendant."""
    from json import dumps

    from brushloop.drivers.loopback import ask

    options = {"on": on, "nth": nth, "phase": phase, "press": press, "count": count}
    options |= {"for_s": for_s, "late_s": late_s, "id": ident}
    fields = {name: value for name, value in options.items() if value is not None}
    request = {"do": what, **fields}
    if kind is not None or what not in ("list", "clear", "state", "release", "fresh-sheet"):
        request = {"do": "add", "fault": {"device": what, "kind": kind or "", **fields}}
    answer = ask(control, request)
    say(*(dumps(answer, indent=2).split("\n") if answer else ["done"]))


@groups["sim"].command()
def hand(
    control: Annotated[Path, typer.Argument(help="Control socket of a lab, made by `brushloop sim --control PATH`.")],
    act: Annotated[str, typer.Argument(help="What the person does: bring, measure or mend.")],
    to: Annotated[str | None, typer.Argument(help="Thing, such as pin; an unknown word lists all things.")] = None,
    index: Annotated[int, typer.Option(min=1, max=999, help="Number of the thing, from 1 (direction at the pin).")] = 1,
    corner: Annotated[str | None, typer.Option(help="Corner of the thing, as 'lower left' or 'upper right'.")] = None,
) -> None:
    """Act as the person in an unknown lab: guide the arm by hand, hold the printed board, correct mistakes."""
    from brushloop.drivers.loopback import ask

    wanted = {"act": act, "to": to, "index": index - 1, "corner": corner}
    say(ask(control, {"do": "hand", **{name: value for name, value in wanted.items() if value is not None}})["says"])


def main() -> None:
    """Run the app; an error with an exit code becomes one line on stderr, any other a traceback."""
    # Imports make many objects that stay: to search them for garbage again and again takes a sixth of every start.
    gc.set_threshold(100_000, 50, 50)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for a terminal that cannot show every character
    try:
        _check_names()
        if len(sys.argv) == 1 and sys.stdin.isatty() and sys.stdout.isatty():
            brushloop.collect.cli.browse()
        else:
            app(prog_name="brushloop")
    except Exception as error:
        code, words = _told(error)
        try:
            # A changed configuration is listed in several lines.
            if words and sys.stderr is not None:
                sys.stderr.write(plain(words, keep="\n") + "\n")
        except OSError:
            sys.stderr = None  # the terminal is gone; Python would write again at its exit, and change the exit code
        if isinstance(error, OSError | OutputClosed):
            sys.stdout = None  # likewise, should it be the output that cannot be written
        sys.exit(code)


def _check_names() -> None:
    """Raise `ArgumentRefused` where an argument or the working folder cannot be written into a report."""
    try:
        here = str(Path.cwd())
    except OSError:
        raise ArgumentRefused("the working folder no longer exists") from None
    for name in (*sys.argv, here):
        if any("\ud800" <= char <= "\udfff" for char in name):
            raise ArgumentRefused(f"{name}: is not UTF-8; give the file or folder another name")


def _told(error: Exception) -> tuple[int, str]:
    """Exit code of an error, and what is said about it: nothing, one line, or the traceback of a defect."""
    code, message = getattr(error, "exit_code", None), str(error)
    if isinstance(error, MemoryError):
        code, message = 4, "not enough memory"
    elif code is None and isinstance(error, OSError):
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            code, message = 4, f"{error.filename or 'the output'}: {error.strerror}"
        elif error.filename:
            # A path given by the user that cannot be read or written is no defect.
            code, message = 2, f"{error.filename}: {error.strerror}"
    if not isinstance(code, int):
        return 1, format_exc().rstrip()
    notes = getattr(error, "__notes__", [])
    return code, " ".join(["brushloop:", message, *notes]) if message else ""


if __name__ == "__main__":
    main()
