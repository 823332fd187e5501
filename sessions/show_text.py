"""Details of a session as text and tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Column, Table
from rich.text import Text

from brushloop.sessions.show import Details, Sheet


def renderables(details: Details, *, files: bool = False) -> Iterator[RenderableType]:
    """Parts to print, top to bottom; `files` adds a row for each step's file, which may be hundreds of lines."""
    yield _facts(details, files=files)
    if details.grid:
        yield _grid(details)
    if files and details.segments:
        yield _segments(details)
    for title, lines in (("Cut attempts", details.void), ("Repaired", details.repairs)):
        if lines:
            yield Text(title, "bold")
            yield from (f"  {line}" for line in lines)


def _facts(details: Details, *, files: bool) -> Table:
    table = Table(show_header=False, box=None)
    table.add_row("session", Text.assemble((details.session_id, "bold"), f", {details.state}, {details.source}"))
    of = f" of {details.planned} planned" if details.planned else ""
    bad = f", and {details.marked_bad} marked bad" if details.marked_bad else ""
    table.add_row("strokes", f"{details.strokes}{of}{bad}")
    steps = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in details.finished.items())
    if details.finished or details.void:
        table.add_row("steps", f"finished: {steps or 'none'}; cut: {len(details.void)}")
    if details.next:
        table.add_row("next", f"{details.next} (under way when the last process ended)")
    for sheet in details.sheets:
        table.add_row(f"sheet {sheet.sheet}", f"{len(sheet.used_patches)} cells used: {ranges(sheet)}")
    for name, value in details.devices.items():
        table.add_row(name.replace("_", " "), value)
    processes = f", {details.processes} processes" if details.processes else ""
    table.add_row("recorded by", f"{details.software}, schema {details.schema_version}{processes}")
    messages = ", ".join(f"{count} {topic}" for topic, count in sorted(details.messages.items()))
    table.add_row("messages", messages or "none")
    if details.segments:
        table.add_row("files", f"{_files(details)}{'' if files else ' (--files lists them)'}")
    if details.file:
        table.add_row("recording", f"{details.file}, {_size(details.size_bytes)}")
    return table


def _grid(details: Details) -> Table:
    heights = sorted({cell.depth_mm for cell in details.grid}, key=lambda h: (h is None, h or 0.0))
    tilts = sorted({cell.tilt_deg for cell in details.grid}, key=lambda a: (a is None, a or 0.0))
    counts = {(c.depth_mm, c.tilt_deg): (c.strokes, c.planned) for c in details.grid}
    table = Table("H \\ alpha", *(_number(tilt, "°") for tilt in tilts), title="Strokes per cell of the grid")
    for height in heights:
        row = [counts.get((height, tilt)) for tilt in tilts]
        table.add_row(_number(height, " mm"), *("" if c is None else _count(*c) for c in row))
    return table


def _segments(details: Details) -> Table:
    file = Column("file", overflow="fold")
    table = Table(file, "step", "size", "messages", title=f"{len(details.segments)} finished steps")
    for segment in details.segments:
        messages = ", ".join(f"{count} {topic}" for topic, count in segment.messages.items())
        table.add_row(segment.file, segment.step, _size(segment.size_bytes), messages)
    return table


def _files(details: Details) -> str:
    """Text such as `2 of finished steps, 0.01 MB, 1 missing`."""
    sizes = [segment.size_bytes for segment in details.segments]
    missing = f", {sizes.count(None)} missing" if None in sizes else ""
    return f"{len(sizes)} of finished steps, {_size(sum(size or 0 for size in sizes))}{missing}"


def ranges(sheet: Sheet) -> str:
    """Cells as `0-3, 7`, with consecutive numbers joined."""
    parts: list[list[int]] = []
    for cell in sheet.used_patches:
        if parts and cell == parts[-1][-1] + 1:
            parts[-1].append(cell)
        else:
            parts.append([cell])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts) or "none"


def _number(value: float | None, unit: str) -> str:
    return "not given" if value is None else f"{value:g}{unit}"


def _count(strokes: int, planned: int | None) -> str:
    return str(strokes) if planned is None else f"{strokes}/{planned}"


def _size(size_bytes: int | None) -> str:
    return "missing" if size_bytes is None else f"{size_bytes / 1e6:.2f} MB"
