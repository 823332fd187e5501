"""The table of points for a registration, and the file that it becomes."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrate.board.artefact import RegistrationFile
from calibrate.board.lens import Floats
from calibrate.board.register import Registration
from calibrate.errors import CalibrationError
from calibrate.files import read_bounded

COLUMNS = ("name", "robot_x_mm", "robot_y_mm", "image_x_px", "image_y_px")


@dataclass(frozen=True, slots=True)
class Points:
    """What the robot was told and where the camera saw it."""

    names: tuple[str, ...]
    robot_mm: Floats
    """(n, 2) in the base frame."""
    image_px: Floats
    """(n, 2) in the photograph as it was taken, pixel centres on integers."""
    sha256: str


def read_points(table: Path) -> Points:
    """Read `COLUMNS`. Raises `CalibrationError` naming line and column."""
    data = read_bounded(table)
    try:
        rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(str(table), f"is no CSV table in UTF-8: {error}") from None
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise CalibrationError(str(table), f"needs rows with the columns {', '.join(COLUMNS)}; missing: {missing[0]}")
    values = [[_number(table, line, name, row[name]) for name in COLUMNS[1:]] for line, row in enumerate(rows, start=2)]
    names = tuple(row["name"].strip() for row in rows)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise CalibrationError(str(table), f"point {twice!r} appears twice")
    numbers = np.array(values)
    return Points(names, numbers[:, :2], numbers[:, 2:], hashlib.sha256(data).hexdigest())


def registration_file(
    fitted: Registration, board_origin_mm: tuple[float, float], source: str, software: str
) -> RegistrationFile:
    """The artefact of a registration."""
    a, b, x, c, d, y = (float(v) for v in fitted.matrix.ravel())
    residuals = {n: (float(r[0]), float(r[1])) for n, r in zip(fitted.names, fitted.residuals_mm, strict=True)}
    return RegistrationFile(
        software=software,
        source=source,
        model=fitted.model,
        robot_to_paper=(a, b, x, c, d, y),
        board_origin_mm=board_origin_mm,
        origin_mm=fitted.origin_mm,
        yaw_deg=fitted.yaw_deg,
        scale=fitted.scale,
        rms_mm=fitted.rms_mm,
        left_out_rms_mm=fitted.left_out_rms_mm,
        residuals_mm={n: r for n, r in residuals.items() if n not in fitted.dropped},
        dropped={n: residuals[n] for n in fitted.dropped},
    )


def _number(table: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CalibrationError(
            str(table), f"line {line}, column `{name}`: {(text or '')[:80]!r} is not a finite number"
        )
    return value
