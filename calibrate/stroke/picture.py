"""All stages of one capture as one picture."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.board.lens import Gray
from calibrate.stroke.stages import Stage, Trace

TILE_PX = 300
CAPTION_PX = 74
COLUMNS = 4
LINES = 3
FONT, HEIGHT, STEP_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 16


def contact_sheet(trace: Trace) -> Gray:
    """(h, w) gray: a tile for each stage with its name and numbers below, flags in the last line."""
    rows = -(-len(trace.stages) // COLUMNS)
    sheet = np.full(
        (rows * (TILE_PX + CAPTION_PX) + 30 + STEP_PX * len(trace.flags), COLUMNS * (TILE_PX + 10)), 255, np.uint8
    )
    for number, stage in enumerate(trace.stages):
        row, column = divmod(number, COLUMNS)
        _tile(sheet, stage, number + 1, 5 + column * (TILE_PX + 10), 5 + row * (TILE_PX + CAPTION_PX))
    below = rows * (TILE_PX + CAPTION_PX) + STEP_PX
    for k, line in enumerate((trace.where, *trace.flags)):
        cv2.putText(
            sheet, line.encode("ascii", "replace").decode(), (8, below + STEP_PX * k), FONT, HEIGHT, 0, 1, cv2.LINE_AA
        )
    return sheet


def _tile(sheet: Gray, stage: Stage, number: int, left: int, top: int) -> None:
    height, width = stage.image.shape
    scale = min(TILE_PX / width, TILE_PX / height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(stage.image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    sheet[top : top + size[1], left : left + size[0]] = small
    cv2.rectangle(sheet, (left - 1, top - 1), (left + size[0], top + size[1]), 160, 1)
    lines = [f"{number} {stage.name}"]
    for name, value in stage.values.items():
        word = f"{name} {value:.4g}"
        if len(lines) > 1 and len(lines[-1]) + len(word) < 40:
            lines[-1] += f", {word}"
        else:
            lines.append(word)
    for k, line in enumerate(lines[: LINES + 1]):
        cv2.putText(sheet, line, (left, top + TILE_PX + 14 + STEP_PX * k), FONT, HEIGHT, 0, 1, cv2.LINE_AA)
