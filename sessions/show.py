"""Contents of one session (steps, strokes per condition, sheets, devices), and lists of sessions.

Only journals and headers are read, no photographs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, ValidationError
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from brushloop.sessions.disk import check_folder, read_bounded
from brushloop.sessions.errors import InputError, SessionError
from brushloop.sessions.events import CaptureResult, step_words
from brushloop.sessions.journal import JOURNAL_NAME, KILLED, RunState, read_header, replay
from brushloop.sessions.recording import Recording, bad_stills, check_path, merged_file
from brushloop.sessions.records import Header, Topic

DEVICES = ("robot", "robot_firmware", "camera", "lens", "brush", "ink", "paper")


@dataclass(slots=True)
class Details:
    """Everything known about a session; can be written as JSON."""

    session_id: str
    state: str
    """`open`, `closed`, or `recording` for a file without a journal."""
    header: Header
    finished: dict[str, int] = field(default_factory=dict[str, int])
    """Finished steps by kind."""
    void: list[str] = field(default_factory=list[str])
    """Attempts that were interrupted, and why."""
    next: str = ""
    """Step under way when the last process ended; empty where none was."""
    strokes: int = 0
    """Number of strokes that the run kept and that were not marked bad since."""
    marked_bad: int = 0
    planned: int | None = None
    conditions: dict[str, str] = field(default_factory=dict[str, str])
    """Strokes of each condition, such as `1 of 2` for `H 13 mm, alpha 5 deg`."""
    sheets: dict[int, list[int]] = field(default_factory=dict[int, list[int]])
    """Patches that were pressed on each sheet, or may have been; sheets are counted from 1."""
    messages: dict[str, int] = field(default_factory=dict[str, int])
    file: str = ""
    """The merged file, once there is one."""
    repairs: list[str] = field(default_factory=list[str])
    verdict: str = ""
    """What its newest report says in one sentence; empty where it was not analysed."""


def details(path: Path) -> Details:
    """Describe a session's folder or an MCAP file. Raises `InputError`, `SessionDamaged`."""
    if (path / JOURNAL_NAME).is_file():
        check_path(path)
        shown = _of_journal(path.resolve())
    else:
        mcap = Recording(path)
        pressed = [(stroke.depth_mm, stroke.tilt_deg) for stroke in mcap.stroke_records()]
        shown = Details(mcap.header.session_id, "recording", mcap.header, strokes=len(pressed), file=mcap.path.name)
        shown.conditions, _ = _conditions(pressed, mcap.header)
        shown.messages = dict(mcap.counts)
    if (verdict := path / "validation" / "verdict.txt").is_file():
        shown.verdict = f"{read_bounded(verdict).decode(errors='replace').strip()} (validation/report.html)"
    return shown


def _of_journal(folder: Path) -> Details:
    state = replay(folder / JOURNAL_NAME)
    header = read_header(folder, state)
    shown = Details(folder.name, "open" if state.closed is None else "closed", header)
    shown.finished = dict(Counter(str(step.kind) for step in state.files.values()))
    shown.void, shown.next = _cut(state)
    shown.messages = state.counts()
    for sheet, patch in sorted(state.used_patches):
        shown.sheets.setdefault(sheet + 1, []).append(patch)
    shown.sheets.setdefault(state.sheet + 1, [])
    bad = bad_stills(folder)
    kept = [capture for capture in state.results(CaptureResult) if capture.kept]
    pressed = [capture.press.condition for capture in kept if capture.still not in bad]
    shown.strokes, shown.marked_bad = len(pressed), len(kept) - len(pressed)
    shown.conditions, shown.planned = _conditions([(one.depth_mm, one.tilt_deg) for one in pressed], header)
    shown.repairs = [f"{repair.event} {repair.file}: {repair.why}" for repair in state.repairs]
    if state.closed is not None and (final := merged_file(folder, state)).is_file():
        shown.file = final.name
    return shown


def _cut(state: RunState) -> tuple[list[str], str]:
    """Attempts that were cut, and the step under way when the last process ended."""
    cut = [*state.cut, *((begin, KILLED) for begin in state.running.values())]
    lines = [f"{step_words(begin)}, attempt {begin.attempt}: {why}" for begin, why in cut]
    open_steps = [step_words(begin) for begin, _ in cut if begin.key not in state.done]
    return lines, open_steps[-1] if open_steps and state.closed is None else ""


class _GridPlan(BaseModel):
    """Protocol of a grid session; `few-strokes` presses only part of the grid that it names."""

    kind: Literal["grid"]
    depths_mm: tuple[float, ...]
    tilts_deg: tuple[float, ...]
    repeats: Annotated[int, Field(ge=0)]


def _conditions(pressed: list[tuple[float | None, float | None]], header: Header) -> tuple[dict[str, str], int | None]:
    """Strokes by depth and tilt, and how many a grid plans in all; None for any other recording."""
    planned: dict[tuple[float | None, float | None], str] = {}
    try:
        plan = _GridPlan.model_validate_json(header.protocol)
        for depth_mm in plan.depths_mm:
            planned |= {(depth_mm, tilt_deg): f" of {plan.repeats}" for tilt_deg in plan.tilts_deg}
        total = plan.repeats * len(planned)
    except ValidationError:
        total = None
    counts = Counter(pressed)
    known = sorted({*counts, *planned}, key=lambda pair: (pair[0] is None, pair[0] or 0.0, pair[1] or 0.0))
    names = {pair: "not given" if None in pair else f"H {pair[0]:g} mm, alpha {pair[1]:g} deg" for pair in known}
    return {names[pair]: f"{counts[pair]}{planned.get(pair, '')}" for pair in known}, total


@dataclass(frozen=True, slots=True)
class Summary:
    """One session in one line."""

    session_id: str
    state: str
    source: str
    strokes: int
    file: str


def summaries(root: Path) -> Iterator[Summary]:
    """Sessions under `root`, by name; `state` says which are damaged. Raises `InputError` where `root` is no folder."""
    if not root.is_dir():
        raise InputError(root, "is not a folder of sessions")
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        try:
            row = _summary(folder)
        except SessionError as error:
            row = Summary(folder.name, "damaged", "", 0, error.path.name)
        if row is not None:
            yield row


def _summary(folder: Path) -> Summary | None:
    check_folder(folder)
    state = replay(folder / JOURNAL_NAME) if (folder / JOURNAL_NAME).is_file() else None
    if state is not None and state.is_open:
        return Summary(folder.name, "open", "", state.counts().get(Topic.STROKE, 0), "")
    if not merged_file(folder, state).is_file():
        return None
    recording = Recording(folder)
    named = "imported" if recording.header.source.imported else "closed"
    return Summary(folder.name, named, recording.header.source, recording.counts[Topic.STROKE], recording.path.name)


def renderables(details: Details) -> Iterator[RenderableType]:
    """Parts to print, top to bottom."""
    yield _facts(details)
    strokes = [f"{name}: {count}" for name, count in details.conditions.items()]
    for title, lines in (("Strokes", strokes), ("Interrupted attempts", details.void), ("Repaired", details.repairs)):
        if lines:
            yield Text(title, "bold")
            yield from (f"  {line}" for line in lines)


def _facts(details: Details) -> Table:
    table = Table(show_header=False, box=None)
    table.add_row("session", Text.assemble((details.session_id, "bold"), f", {details.state}, {details.header.source}"))
    of = f" of {details.planned} planned" if details.planned else ""
    bad = f", and {details.marked_bad} marked bad" if details.marked_bad else ""
    table.add_row("strokes", f"{details.strokes}{of}{bad}")
    if details.verdict:
        table.add_row("report", details.verdict)
    steps = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in details.finished.items())
    if details.finished or details.void:
        interrupted = f"; {len(details.void)} interrupted" if details.void else ""
        table.add_row("steps", f"{steps or 'none'} finished{interrupted}")
    if details.next:
        table.add_row("next", f"{details.next} (under way when the last process ended)")
    for sheet, used_patches in details.sheets.items():
        table.add_row(f"sheet {sheet}", f"{len(used_patches)} patches used")
    for name in DEVICES:
        if value := getattr(details.header, name):
            table.add_row(name.replace("_", " "), value)
    table.add_row("recorded by", f"{details.header.software}, schema {details.header.schema_version}")
    table.add_row("messages", ", ".join(f"{n} {topic}" for topic, n in sorted(details.messages.items())) or "none")
    if details.file:
        table.add_row("recording", details.file)
    return table
