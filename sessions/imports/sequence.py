"""Import a page that was photographed after every stroke: frame k + 1 shows one stroke more than frame k.

Every frame is a still. Stroke k refers to the still taken after it; the still taken before it has the
previous sequence number. A reader of the session finds the stroke's ink by comparing the two.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

from sessions.errors import InputError, in_one_line
from sessions.imports.photographs import ImportOptions, check_target, gray_of, store_rows
from sessions.imports.table import Row, parse_table, read_text
from sessions.progress import Progress, unseen

SEQUENCE = "page sequence"
"""Start of the header's `protocol`: says that each still also shows all earlier strokes."""
PHOTOGRAPHS = (".png", ".jpg", ".jpeg")


def import_sequence(
    folder: Path,
    table: Path | None,
    out: Path,
    options: ImportOptions,
    software: str,
    now_ns: Callable[[], int],
    page_mm: tuple[float, float] | None = None,
    *,
    progress: Progress = unseen,
) -> Path:
    """Import frames into a new session folder `out`; return its MCAP file. Raises `InputError`, leaving nothing behind.

    The table has the columns `before` and `after`, and any commanded values; each line's `after` is the next line's
    `before`. Without a table the frames are taken in the order of their names, and no commanded values are known.
    `page_mm` (width and height of the area that a photograph shows) sets the scale where the table has none.
    """
    named = table or folder
    check_target(folder, named, out, options)
    if table is None:
        frames, text = _by_name(folder)
    else:
        frames, text = _by_table(table)
    opening = _frame(folder, named, frames[0])
    size = _size(opening)
    if page_mm is not None:
        text = _with_scale(text, (size[0] / page_mm[0], size[1] / page_mm[1]))
    rows = parse_table(folder, named, text, "drag", options.px_per_mm)
    for row in rows:
        if (other := _size(row.image)) != size:
            raise InputError(row.image, f"is {other[0]} x {other[1]} px, the first frame {size[0]} x {size[1]}")
    stills = enumerate(rows, start=1)
    numbered = Row.spooled(Row(row.image, row.stroke.model_copy(update={"still": k})) for k, row in stills)
    protocol = f"{SEQUENCE}: {len(rows)} strokes on one page, one new stroke a frame"
    return store_rows(
        numbered, folder, named, out, options, protocol, software, now_ns, opening=opening, progress=progress
    )


def _by_table(table: Path) -> tuple[list[str], str]:
    """Return the frames in order, and the table with `after` renamed `file`; check that the frames form one chain."""
    try:
        lines = [[cell.strip() for cell in line] for line in csv.reader(io.StringIO(read_text(table)), strict=True)]
    except csv.Error as error:
        raise InputError(table, f"is not a table: {error}") from None
    head = lines[0] if lines else []
    for column in ("before", "after"):
        if head.count(column) != 1:
            raise InputError(table, f"column `{column}` is missing; found: {', '.join(head)[:200] or 'none'}")
    before, after = head.index("before"), head.index("after")
    frames: list[str] = []
    for number, cells in enumerate(lines[1:], start=2):
        if not any(cells):
            continue
        if len(cells) != len(head):
            raise InputError(table, f"line {number} has {len(cells)} fields, expected {len(head)}")
        if frames and cells[before] != frames[-1]:
            what = f"line {number}: `before` is {cells[before][:80]!r}, the frame before it is {frames[-1][:80]!r}"
            raise InputError(table, what)
        frames += [cells[after]] if frames else [cells[before], cells[after]]
    if not frames:
        raise InputError(table, "has no rows")
    head = ["file" if name == "after" else name for name in head]
    kept = [k for k in range(len(head)) if k != before]
    return frames, _text([[line[k] for k in kept] if any(line) else line for line in [head, *lines[1:]]])


def _by_name(folder: Path) -> tuple[list[str], str]:
    try:
        frames = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPHS)
    except OSError as error:
        raise InputError(folder, f"cannot read: {in_one_line(error)}") from None
    if len(frames) < 2:
        raise InputError(folder, f"holds {len(frames)} photographs, a sequence needs at least 2")
    return frames, _text([["file"], *([name] for name in frames[1:])])


def _with_scale(text: str, px_per_mm: tuple[float, float]) -> str:
    lines = list(csv.reader(io.StringIO(text)))
    added = [["px_per_mm_x", "px_per_mm_y"], *([repr(px_per_mm[0]), repr(px_per_mm[1])] for _ in lines[1:])]
    return _text([line + more if any(line) else line for line, more in zip(lines, added, strict=True)])


def _text(lines: list[list[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(lines)  # noqa: TID251 - parsed again by this module, never saved
    return out.getvalue()


def _frame(folder: Path, named: Path, name: str) -> Path:
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        raise InputError(named, f"frame {name[:80]!r} is not in {folder.name}/")
    return path


def _size(path: Path) -> tuple[int, int]:
    height, width = gray_of(path).shape
    return width, height
