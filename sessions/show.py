"""Contents of one session (steps, strokes per cell of the grid, sheets, files, devices), and lists of sessions.

Only journals and headers are read, no photographs.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, in_one_line
from brushloop.sessions.folders import check_name, recording_of_renamed
from brushloop.sessions.journal import JOURNAL_NAME, Line
from brushloop.sessions.journal.events import NONSENSE
from brushloop.sessions.journal.journal import Replay, is_open, read_header, replay, replay_lines
from brushloop.sessions.names import check_folder
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Stroke, Topic
from brushloop.sessions.remarks import remarks_of

DEVICES = ("robot", "robot_firmware", "camera", "lens", "brush", "ink", "paper")


@dataclass(frozen=True, slots=True)
class Segment:
    """One finished step's file."""

    file: str
    step: str
    size_bytes: int | None
    """None if the file is missing."""
    messages: dict[str, int]


@dataclass(frozen=True, slots=True)
class Sheet:
    """One sheet of paper, counted from 1, and the cells that were pressed on it or may have been."""

    sheet: int
    used_patches: list[int]


@dataclass(frozen=True, slots=True)
class GridCell:
    """Number of strokes of one (H, alpha); `planned` is None if the protocol does not state it."""

    depth_mm: float | None
    tilt_deg: float | None
    strokes: int
    planned: int | None


@dataclass(slots=True)
class Details:
    """Everything known about a session; can be written as JSON."""

    session_id: str
    state: str
    """`open`, `closed`, or `recording` for a file without a journal."""
    source: str
    devices: dict[str, str]
    software: str
    schema_version: int
    finished: dict[str, int]
    """Finished steps by kind."""
    void: list[str] = field(default_factory=list[str])
    """Attempts that were cut, and why."""
    next: str = ""
    """Step under way when the last process ended; empty where none was."""
    strokes: int = 0
    """Number of strokes that the run kept and that were not marked bad since."""
    marked_bad: int = 0
    planned: int | None = None
    grid: list[GridCell] = field(default_factory=list[GridCell])
    sheets: list[Sheet] = field(default_factory=list[Sheet])
    segments: list[Segment] = field(default_factory=list[Segment])
    processes: int = 0
    messages: dict[str, int] = field(default_factory=dict[str, int])
    file: str = ""
    """The merged file, once there is one."""
    size_bytes: int | None = None
    repairs: list[str] = field(default_factory=list[str])


def details(path: Path) -> Details:
    """Describe a session's folder or an MCAP file. Raises `InputError`, `SessionDamaged`."""
    if (path / JOURNAL_NAME).is_file():
        check_name(path)
        return _of_journal(path.resolve())
    recording = Recording(path)
    found = _of_header(recording.header, "recording")
    strokes = list(recording.stroke_records())
    found.strokes, found.grid = len(strokes), _grid(strokes, recording.header)
    found.messages = recording.counts
    found.file, found.size_bytes = recording.path.name, recording.path.stat().st_size
    return found


def _of_header(header: Header, state: str) -> Details:
    values = header.model_dump(mode="json")
    devices = {name: str(values[name]) for name in DEVICES if values[name]}
    return Details(header.session_id, state, header.source, devices, header.software, header.schema_version, {})


def _of_journal(folder: Path) -> Details:
    """Raise `SessionDamaged` also for well-formed lines that make no sense, such as a grid without numbers."""
    state, lines = replay_lines(folder / JOURNAL_NAME)
    try:
        return _read(folder, state, lines)
    except (*NONSENSE, ValidationError) as error:
        raise SessionDamaged(folder / JOURNAL_NAME, f"makes no sense: {in_one_line(error)}") from None


def _read(folder: Path, state: Replay, lines: list[Line]) -> Details:
    header = read_header(folder, state)
    found = _of_header(header, "open" if state.closed is None else "closed")
    found.session_id = folder.name
    found.processes = sum(line["event"] == "process" for line in lines)
    found.finished = dict(Counter(str(line["kind"]) for line in state.segments))
    found.void, found.next = _voids(lines, state)
    found.messages = state.counts()
    found.segments = [_segment(folder, line) for line in state.segments]
    used = {sheet for sheet, _cell in state.used_patches} | {state.sheet}
    found.sheets = [
        Sheet(n + 1, sorted(cell for sheet, cell in state.used_patches if sheet == n)) for n in sorted(used)
    ]
    with_stroke = [line for line in state.segments if Topic.STROKE in line["counts"]]
    bad = {remark.still for remark in remarks_of(folder).values() if remark.bad}
    counted = [line for line in with_stroke if line["result"].get("still") not in bad]
    found.marked_bad = len(with_stroke) - len(counted)
    found.strokes = sum(line["counts"].get(Topic.STROKE, 0) for line in counted)
    found.grid = _grid([_commanded(line, lines) for line in counted], header)
    found.planned = sum(cell.planned or 0 for cell in found.grid) if _protocol(header) else None
    found.repairs = [f"{line['event']} {line['file']}: {line.get('why', '')}" for line in state.repairs]
    final = folder / f"{folder.name}.mcap"
    if state.closed is not None and final.is_file():
        found.file, found.size_bytes = final.name, final.stat().st_size
    return found


def _voids(lines: list[Line], state: Replay) -> tuple[list[str], str]:
    """Attempts that were cut, and the step under way when the last process ended."""
    began: dict[tuple[Any, Any], Line] = {}
    voids: list[str] = []
    last = ""
    for line in lines:
        ident = (line.get("key"), line.get("attempt"))
        match line["event"]:
            case "begin":
                began[ident] = line
            case "done":
                began.pop(ident, None)
            case "void" if ident in began:
                cut = began.pop(ident)
                voids.append(f"{step_words(cut)}, attempt {line['attempt']}: {line.get('why', '')}")
                last = step_words(cut) if cut["key"] not in state.done else ""
            case _:
                pass
    for line in began.values():
        voids.append(f"{step_words(line)}, attempt {line['attempt']}: the process ended during it")
        last = step_words(line) if line["key"] not in state.done else last
    return voids, last if state.closed is None else ""


def step_words(line: Line) -> str:
    """Name of the step of a `begin` or `done` line for people: `capture H13-a05-r02`."""
    stroke = {**line.get("params", {}), **line.get("result", {})}.get("stroke_id", "")
    return f"{line.get('kind', 'step')} {stroke}".strip().replace("_", " ")


def _segment(folder: Path, line: Line) -> Segment:
    path = folder / str(line["file"])
    size = path.stat().st_size if path.is_file() else None
    return Segment(path.name, step_words(line), size, line["counts"])


def _commanded(line: Line, lines: list[Line]) -> Stroke:
    """Stroke as the journal describes it: height and tilt from its parameters or its result."""
    params: Line = {}
    for begin in lines:
        if begin["event"] == "begin" and begin["key"] == line["key"]:
            params = begin.get("params", {})
    values = {**params, **line["result"]}
    height, tilt = (values.get(name) for name in ("depth_mm", "tilt_deg"))
    return Stroke(stroke_id=str(values.get("stroke_id", "")), kind="press", still=0, depth_mm=height, tilt_deg=tilt)


def _protocol(header: Header) -> dict[str, Any]:
    """Protocol of a grid session; empty for any other recording."""
    try:
        found: Any = json.loads(header.protocol)
    except ValueError:
        return {}
    protocol: dict[str, Any] = dict(found) if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownArgumentType]
    # `few-strokes`, and `adaptive` of earlier versions, press only part of the grid that they name.
    is_grid = protocol.get("kind", "grid") == "grid" and protocol.keys() >= {"depths_mm", "tilts_deg", "repeats"}
    return protocol if is_grid else {}


def _grid(strokes: list[Stroke], header: Header) -> list[GridCell]:
    have = Counter((stroke.depth_mm, stroke.tilt_deg) for stroke in strokes)
    protocol = _protocol(header)
    planned = {
        (float(h), float(a)): int(protocol["repeats"])
        for h in protocol.get("depths_mm", ())
        for a in protocol["tilts_deg"]
    }
    cells = sorted({*have, *planned}, key=lambda cell: (cell[0] is None, cell[0] or 0.0, cell[1] or 0.0))
    return [
        GridCell(h, a, have[h, a], planned.get((h, a)) if h is not None and a is not None else None) for h, a in cells
    ]


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
    collected = (folder / JOURNAL_NAME).is_file()
    if collected and is_open(state := replay(folder / JOURNAL_NAME)):
        strokes = sum(line["counts"].get(Topic.STROKE, 0) for line in state.segments)
        return Summary(folder.name, "open", "", strokes, "")
    merged = folder / f"{folder.name}.mcap"
    renamed = None if merged.is_file() else recording_of_renamed(folder)
    if renamed is None and not merged.is_file():
        return None
    recording = Recording(renamed or merged)
    state_name = "imported" if recording.header.source.imported else "closed"
    if renamed is not None:
        return Summary(folder.name, "renamed", recording.header.source, recording.strokes(), renamed.name)
    return Summary(folder.name, state_name, recording.header.source, recording.strokes(), merged.name)
