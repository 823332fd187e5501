"""What is in a session: steps, strokes per cell of the grid, sheets, files, devices. Reads no photograph."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sessions.errors import InputError, SessionDamaged, in_one_line
from sessions.journal.codec import Line
from sessions.journal.events import NONSENSE
from sessions.journal.journal import JOURNAL_NAME, Replay, replay_lines
from sessions.reader import Recording
from sessions.recording import container
from sessions.recording.schemas import Header, Stroke, Topic
from sessions.remarks import remarks_of
from sessions.renamed import check_name
from sessions.store import counts_of, read_header

DEVICES = ("robot", "robot_firmware", "camera", "lens", "brush", "ink", "paper")


@dataclass(frozen=True, slots=True)
class Segment:
    """One finished step's file."""

    file: str
    step: str
    size_bytes: int | None
    """None where the file is not there."""
    messages: dict[str, int]


@dataclass(frozen=True, slots=True)
class Sheet:
    """One sheet of paper, counted from 1, and the cells that were pressed on it or may have been."""

    sheet: int
    used_cells: list[int]


@dataclass(frozen=True, slots=True)
class GridCell:
    """How many strokes of one (H, alpha) there are; `planned` is None where the protocol does not tell."""

    height_mm: float | None
    tilt_deg: float | None
    strokes: int
    planned: int | None


@dataclass(slots=True)
class Details:
    """A session in full, fit for JSON."""

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
    """The step that was being done when the last process ended; empty where none was."""
    strokes: int = 0
    """That count: kept by the run, and not marked bad since."""
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
    """Look at a session's folder or an MCAP file. Raises `InputError`, `SessionDamaged`."""
    if (path / JOURNAL_NAME).is_file():
        check_name(path)
        return _of_journal(path.resolve())
    if not path.exists():
        raise InputError(path, "no such session: give a session's folder or its .mcap file")
    recording = Recording(path)
    told = _of_header(recording.header, "recording")
    strokes = list(recording.stroke_records())
    told.strokes, told.grid = len(strokes), _grid(strokes, recording.header)
    told.messages = container.indexed_counts(recording.path)
    told.file, told.size_bytes = recording.path.name, recording.path.stat().st_size
    return told


def _of_header(header: Header, state: str) -> Details:
    values = header.model_dump(mode="json")
    devices = {name: str(values[name]) for name in DEVICES if values[name]}
    return Details(header.session_id, state, header.source, devices, header.software, header.schema_version, {})


def _of_journal(folder: Path) -> Details:
    """Raises `SessionDamaged` also for what reads well and makes no sense, as a grid of no numbers."""
    state, lines = replay_lines(folder / JOURNAL_NAME)
    try:
        return _told(folder, state, lines)
    except (*NONSENSE, ValidationError) as error:
        raise SessionDamaged(folder / JOURNAL_NAME, f"makes no sense: {in_one_line(error)}") from None


def _told(folder: Path, state: Replay, lines: list[Line]) -> Details:
    header = read_header(folder, state)
    told = _of_header(header, "open" if state.closed is None else "closed")
    told.session_id = folder.name
    told.processes = sum(line["event"] == "process" for line in lines)
    told.finished = dict(Counter(str(line["kind"]) for line in state.segments))
    told.void, told.next = _voids(lines, state)
    told.messages = counts_of(state)
    told.segments = [_segment(folder, line) for line in state.segments]
    used = {sheet for sheet, _cell in state.used_cells} | {state.sheet}
    told.sheets = [Sheet(n + 1, sorted(cell for sheet, cell in state.used_cells if sheet == n)) for n in sorted(used)]
    with_stroke = [line for line in state.segments if Topic.STROKE in line["counts"]]
    bad = {remark.still for remark in remarks_of(folder).values() if remark.bad}
    counted = [line for line in with_stroke if line["result"].get("still") not in bad]
    told.marked_bad = len(with_stroke) - len(counted)
    told.strokes = sum(line["counts"].get(Topic.STROKE, 0) for line in counted)
    told.grid = _grid([_commanded(line, lines) for line in counted], header)
    told.planned = sum(cell.planned or 0 for cell in told.grid) if _protocol(header) else None
    told.repairs = [f"{line['event']} {line['file']}: {line.get('why', '')}" for line in state.repairs]
    final = folder / f"{folder.name}.mcap"
    if state.closed is not None and final.is_file():
        told.file, told.size_bytes = final.name, final.stat().st_size
    return told


def _voids(lines: list[Line], state: Replay) -> tuple[list[str], str]:
    """Every attempt that did not end as it should, and the step that the last process was at."""
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
                voids.append(f"{_words(cut)}, attempt {line['attempt']}: {line.get('why', '')}")
                last = _words(cut) if cut["key"] not in state.done else ""
            case _:
                pass
    for line in began.values():
        voids.append(f"{_words(line)}, attempt {line['attempt']}: the process ended during it")
        last = _words(line) if line["key"] not in state.done else last
    return voids, last if state.closed is None else ""


def _words(begin: Line) -> str:
    stroke = begin.get("params", {}).get("stroke_id", "")
    return f"{begin['kind']} {stroke}".strip().replace("_", " ")


def _segment(folder: Path, line: Line) -> Segment:
    path = folder / str(line["file"])
    size = path.stat().st_size if path.is_file() else None
    stroke = line["result"].get("stroke_id", "")
    return Segment(path.name, f"{line['kind']} {stroke}".strip().replace("_", " "), size, line["counts"])


def _commanded(line: Line, lines: list[Line]) -> Stroke:
    """A stroke as far as the journal tells it: height and tilt from its parameters or its result."""
    params: Line = {}
    for begin in lines:
        if begin["event"] == "begin" and begin["key"] == line["key"]:
            params = begin.get("params", {})
    values = {**params, **line["result"]}
    height, tilt = (values.get(name) for name in ("height_mm", "tilt_deg"))
    return Stroke(stroke_id=str(values.get("stroke_id", "")), kind="press", still=0, height_mm=height, tilt_deg=tilt)


def _protocol(header: Header) -> dict[str, Any]:
    """The grid's protocol as it was recorded; empty where the recording was made by other means."""
    try:
        told: Any = json.loads(header.protocol)
    except ValueError:
        return {}
    protocol: dict[str, Any] = dict(told) if isinstance(told, dict) else {}  # pyright: ignore[reportUnknownArgumentType]
    # An adaptive one presses what it needs, not the whole grid that it chooses from.
    is_grid = protocol.get("kind", "grid") == "grid" and protocol.keys() >= {"heights_mm", "tilts_deg", "repeats"}
    return protocol if is_grid else {}


def _grid(strokes: list[Stroke], header: Header) -> list[GridCell]:
    have = Counter((stroke.height_mm, stroke.tilt_deg) for stroke in strokes)
    protocol = _protocol(header)
    planned = {
        (float(h), float(a)): int(protocol["repeats"])
        for h in protocol.get("heights_mm", ())
        for a in protocol["tilts_deg"]
    }
    cells = sorted({*have, *planned}, key=lambda cell: (cell[0] is None, cell[0] or 0.0, cell[1] or 0.0))
    return [
        GridCell(h, a, have[h, a], planned.get((h, a)) if h is not None and a is not None else None) for h, a in cells
    ]
