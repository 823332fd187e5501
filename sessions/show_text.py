"""A session's details for people."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType
from rich.table import Column, Table
from rich.text import Text

from sessions.show import Details, Sheet


def renderables(told: Details, *, files: bool = False) -> Iterator[RenderableType]:
    """One after the other, top to bottom; `files`: each step's file as well, which may be hundreds of lines."""
    yield _facts(told, files=files)
    if told.grid:
        yield _grid(told)
    if files and told.segments:
        yield _segments(told)
    for title, lines in (("Cut attempts", told.void), ("Repaired", told.repairs)):
        if lines:
            yield Text(title, "bold")
            yield from (f"  {line}" for line in lines)


def _facts(told: Details, *, files: bool) -> Table:
    table = Table(show_header=False, box=None)
    table.add_row("session", Text.assemble((told.session_id, "bold"), f", {told.state}, {told.source}"))
    of = f" of {told.planned} planned" if told.planned else ""
    bad = f", and {told.marked_bad} marked bad" if told.marked_bad else ""
    table.add_row("strokes", f"{told.strokes}{of}{bad}")
    steps = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in told.finished.items())
    if told.finished or told.void:
        table.add_row("steps", f"finished: {steps or 'none'}; cut: {len(told.void)}")
    if told.next:
        table.add_row("next", f"{told.next} (was being done when the last process ended)")
    for sheet in told.sheets:
        table.add_row(f"sheet {sheet.sheet}", f"{len(sheet.used_cells)} cells used: {ranges(sheet)}")
    for name, value in told.devices.items():
        table.add_row(name.replace("_", " "), value)
    processes = f", {told.processes} processes" if told.processes else ""
    table.add_row("recorded by", f"{told.software}, schema {told.schema_version}{processes}")
    messages = ", ".join(f"{count} {topic}" for topic, count in sorted(told.messages.items()))
    table.add_row("messages", messages or "none")
    if told.segments:
        table.add_row("files", f"{_files(told)}{'' if files else ' (--files lists them)'}")
    if told.file:
        table.add_row("recording", f"{told.file}, {_size(told.size_bytes)}")
    return table


def _grid(told: Details) -> Table:
    heights = sorted({cell.height_mm for cell in told.grid}, key=lambda h: (h is None, h or 0.0))
    tilts = sorted({cell.tilt_deg for cell in told.grid}, key=lambda a: (a is None, a or 0.0))
    counts = {(c.height_mm, c.tilt_deg): (c.strokes, c.planned) for c in told.grid}
    table = Table("H \\ alpha", *(_number(tilt, "°") for tilt in tilts), title="Strokes per cell of the grid")
    for height in heights:
        row = [counts.get((height, tilt)) for tilt in tilts]
        table.add_row(_number(height, " mm"), *("" if c is None else _count(*c) for c in row))
    return table


def _segments(told: Details) -> Table:
    file = Column("file", overflow="fold")
    table = Table(file, "step", "size", "messages", title=f"{len(told.segments)} finished steps")
    for segment in told.segments:
        messages = ", ".join(f"{count} {topic}" for topic, count in segment.messages.items())
        table.add_row(segment.file, segment.step, _size(segment.size_bytes), messages)
    return table


def _files(told: Details) -> str:
    """`2 of finished steps, 0.01 MB, 1 missing`."""
    sizes = [segment.size_bytes for segment in told.segments]
    missing = f", {sizes.count(None)} missing" if None in sizes else ""
    return f"{len(sizes)} of finished steps, {_size(sum(size or 0 for size in sizes))}{missing}"


def ranges(sheet: Sheet) -> str:
    """`0-3, 7`: numbers that follow each other are put together."""
    parts: list[list[int]] = []
    for cell in sheet.used_cells:
        if parts and cell == parts[-1][-1] + 1:
            parts[-1].append(cell)
        else:
            parts.append([cell])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts) or "none"


def _number(value: float | None, unit: str) -> str:
    return "not told" if value is None else f"{value:g}{unit}"


def _count(strokes: int, planned: int | None) -> str:
    return str(strokes) if planned is None else f"{strokes}/{planned}"


def _size(size_bytes: int | None) -> str:
    return "missing" if size_bytes is None else f"{size_bytes / 1e6:.2f} MB"
