"""Register the robot to the paper, from marks that it touched or pressed and that the camera saw.

Where the paper lies is written into `rig.toml`: only two values change in the text. Comments, order and everything else
stay, and the old file is kept beside it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomlkit
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Artefact, made_by
from brushloop.calibrate.board.lens import Floats, rms
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.board.view import rig_view
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded, write_whole
from brushloop.sessions.disk import number

COLUMNS = ("name", "robot_x_mm", "robot_y_mm", "image_x_px", "image_y_px")
LEAST_POINTS = 3
WORST_RMS_MM = 5.0
Paper = dict[str, list[float] | float]
"""Fields of `[paper]` in rig.toml and their values."""
TRIALS = 500
OUTLIER_MEDIANS = 5.0
LEAST_OUTLIER_MM = 0.3
"""Marks that lie closer than this to the predicted place are never outliers."""
MIXED_UP_MM, EXPLAINED = 3.0, 0.2
"""A misfit is taken for mixed names only above this, and if they explain all but this share of it."""


class Registration(Artefact):
    """The place and turn of the paper frame in the robot's base frame, both in mm, and what it was made from."""

    robot_to_paper: tuple[float, float, float, float, float, float]
    """(2, 3) row by row: mm in the base frame to mm in the paper frame."""
    origin_mm: tuple[float, float]
    """Origin of the paper frame in the base frame, as in `paper.origin_mm`."""
    yaw_deg: float
    """Yaw of the paper frame in the base frame, counter-clockwise from base x to paper x, as in `paper.yaw_deg`."""
    rms_mm: float
    left_out_rms_mm: float
    """Root mean square error of the kept points, each predicted by the others: what to expect of a new point."""
    residuals_mm: dict[str, tuple[float, float]]
    """Seen minus predicted, of each kept point."""
    dropped: dict[str, tuple[float, float]]
    schema_version: Literal[4] = 4
    software: str
    source: str
    """The table of points, or the session, and its sha256."""
    board_origin_mm: tuple[float, float]
    """Lower left corner of the board in the paper frame, as it was assumed."""

    @property
    def matrix(self) -> Floats:
        """`robot_to_paper` as (2, 3)."""
        return np.array(self.robot_to_paper).reshape(2, 3)

    @property
    def paper(self) -> Paper:
        """The two values of `[paper]` in rig.toml, rounded to 0.001 mm and 0.0001 deg."""
        # Adding 0 turns -0.0 into 0.0.
        return {"origin_mm": [round(v, 3) + 0.0 for v in self.origin_mm], "yaw_deg": round(self.yaw_deg, 4) + 0.0}


def toml_lines(paper: Paper) -> list[str]:
    """The lines to paste into rig.toml."""
    return [f"{name} = {value}" for name, value in paper.items()]


def register(
    names: Sequence[str], robot_mm: Floats, seen_mm: Floats, source: str, board_origin_mm: tuple[float, float]
) -> Registration:
    """Fit by least squares to (n, 2) points of both frames, with outliers dropped and named (Umeyama 1991, eq. 40-43).

    `source` and `board_origin_mm` are kept with the result. Outliers are found by the two points that best explain the
    others. Raises `CalibrationError` for fewer than three points, for points that are all in one place, and if most do
    not fit together.
    """
    where = f"{len(names)} points"
    if not len(names) == len(robot_mm) == len(seen_mm):
        raise ValueError(f"{len(names)} names, {len(robot_mm)} and {len(seen_mm)} points")
    if len(names) < LEAST_POINTS:
        raise CalibrationError(where, f"at least {LEAST_POINTS} are needed")
    if np.ptp(robot_mm, axis=0).max() < 1.0:
        raise CalibrationError(where, "lie within 1 mm: touch the paper at places far apart")
    if problem := mixed_up(names, robot_mm, seen_mm):
        raise CalibrationError(where, problem)
    kept = _agreeing(robot_mm, seen_mm)
    if kept.sum() < max(LEAST_POINTS, (len(names) + 1) // 2):
        raise CalibrationError(where, f"only {kept.sum()} agree: are their names mixed up?")
    matrix = _fit(robot_mm[kept], seen_mm[kept])
    residuals = seen_mm - _apply(matrix, robot_mm)
    if rms(residuals[kept]) > WORST_RMS_MM:
        problem = f"{rms(residuals[kept]):.1f} mm off on average, allowed {WORST_RMS_MM:g}: are their names mixed up?"
        raise CalibrationError(where, problem)
    left_out: list[Floats] = []
    for index in np.flatnonzero(kept):
        others = kept.copy()
        others[index] = False
        alone = _fit(robot_mm[others], seen_mm[others])
        left_out.append(seen_mm[index] - _apply(alone, robot_mm[[index]])[0])
    each = {name: (float(x), float(y)) for name, (x, y) in zip(names, residuals, strict=True)}
    a, b, x, c, d, y = (float(v) for v in matrix.ravel())
    origin = -matrix[:, 2] @ np.linalg.inv(matrix[:, :2]).T
    return Registration(
        robot_to_paper=(a, b, x, c, d, y),
        origin_mm=(float(origin[0]), float(origin[1])),
        # The transformation from the base frame to the paper frame turns points the other way.
        yaw_deg=float(np.degrees(np.arctan2(-c, a))),
        rms_mm=rms(residuals[kept]),
        left_out_rms_mm=rms(np.array(left_out)),
        residuals_mm={name: each[name] for name, keep in zip(names, kept, strict=True) if keep},
        dropped={name: each[name] for name, keep in zip(names, kept, strict=True) if not keep},
        software=made_by(),
        source=source,
        board_origin_mm=board_origin_mm,
    )


def mixed_up(names: Sequence[str], robot_mm: Floats, seen_mm: Floats) -> str:
    """Why the points do not fit: a mirror, or two names that were exchanged; empty if they fit, or if nothing
    explains it.

    `robot_mm` and `seen_mm` are (n, 2). An explanation counts if it leaves a fifth of the largest misfit or less.
    """
    as_named = _worst(robot_mm, seen_mm)
    if as_named <= MIXED_UP_MM:
        return ""
    enough_mm = max(LEAST_OUTLIER_MM, EXPLAINED * as_named)
    if _worst(robot_mm * [1.0, -1.0], seen_mm) <= enough_mm:
        return (
            f"fit only as in a mirror (off by {as_named:.1f} mm otherwise): were they named from the other side, or is "
            "the photograph mirrored?"
        )
    exchanges = list[tuple[float, str]]()
    for a, b in itertools.combinations(range(len(names)), 2):
        exchanged = robot_mm.copy()
        exchanged[[a, b]] = robot_mm[[b, a]]
        exchanges.append((_worst(exchanged, seen_mm), f"{names[a]} and {names[b]}"))
    off_mm, pair = min(exchanges)
    if off_mm > enough_mm:
        return ""
    return f"fit only if {pair} are swapped (off by {as_named:.1f} mm otherwise): one was touched in the other's place"


def _worst(robot_mm: Floats, seen_mm: Floats) -> float:
    """Largest distance that a rigid fit leaves."""
    off = seen_mm - _apply(_fit(robot_mm, seen_mm), robot_mm)
    return float(np.linalg.norm(off, axis=1).max())


def _agreeing(robot_mm: Floats, seen_mm: Floats) -> NDArray[np.bool_]:
    best = np.full(len(robot_mm), np.inf)
    few = list(itertools.combinations(range(len(robot_mm)), 2))
    for chosen in few[:: max(1, len(few) // TRIALS)]:
        points = robot_mm[list(chosen)]
        if np.linalg.norm(points[1] - points[0]) < 2.0**0.5:  # points in one place determine nothing
            continue
        away = np.linalg.norm(seen_mm - _apply(_fit(points, seen_mm[list(chosen)]), robot_mm), axis=1)
        if np.median(away) < np.median(best):
            best = away
    if not np.isfinite(best).all():
        return np.zeros(len(robot_mm), np.bool_)
    rough = best <= max(LEAST_OUTLIER_MM, OUTLIER_MEDIANS * float(np.median(best)))
    # Judge again by the fit to all that agree: a fit to two points is inaccurate.
    away = np.linalg.norm(seen_mm - _apply(_fit(robot_mm[rough], seen_mm[rough]), robot_mm), axis=1)
    return away <= max(LEAST_OUTLIER_MM, OUTLIER_MEDIANS * float(np.median(away)))


def _fit(robot_mm: Floats, seen_mm: Floats) -> Floats:
    from_middle, to_middle = robot_mm.mean(axis=0), seen_mm.mean(axis=0)
    a, b = robot_mm - from_middle, seen_mm - to_middle
    u, _, vt = np.linalg.svd(b.T @ a)
    # Both frames are right-handed: a mirrored fit is never wanted.
    linear = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt)) or 1.0]) @ vt
    return np.column_stack([linear, to_middle - linear @ from_middle])


def _apply(matrix: Floats, points: Floats) -> Floats:
    return points @ matrix[:, :2].T + matrix[:, 2]


@dataclass(frozen=True, slots=True)
class Points:
    """Points that the robot was commanded to, and where the camera saw them."""

    names: tuple[str, ...]
    robot_mm: Floats
    """(n, 2) in the base frame."""
    image_px: Floats
    """(n, 2) in the photograph as it was taken, pixel centres on integers."""
    sha256: str


def read_points(table: Path) -> Points:
    """Read a table with `COLUMNS`. Raises `CalibrationError` naming line and column."""
    data = read_bounded(table)
    try:
        rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(str(table), f"is not a CSV table in UTF-8: {error}") from None
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


def _number(table: Path, line: int, name: str, text: str | None) -> float:
    try:
        return number(text or "")
    except ValueError as error:
        raise CalibrationError(str(table), f"line {line}, column `{name}`: {error}") from None


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig's configuration as text, with the board and the lens file that it names."""

    path: Path
    text: str
    board: BoardSpec
    lens_file: Path | None

    def write(self, paper: Paper) -> Path:
        """Write these two values; returns the path of the old file. Raises `CalibrationError` and OSError."""
        document: Any = tomlkit.parse(self.text)
        if not isinstance(document.get("paper"), dict):
            what = "paper: is not a table; nothing is written. Enter by hand: " + ", ".join(toml_lines(paper))
            raise CalibrationError(str(self.path), what)
        for name, value in paper.items():
            document["paper"][name] = value
        kept = free_name(self.path)
        with kept.open("xb") as file:
            file.write(self.text.encode())
        write_whole(self.path.resolve(), tomlkit.dumps(document))
        return kept


def read_rig(path: Path) -> RigFile:
    """Read a rig's configuration. Raises `CalibrationError` that names file and field."""
    try:
        text = read_bounded(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise CalibrationError(str(path), f"is not UTF-8 at byte {error.start}") from None
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise CalibrationError(str(path), f"is not TOML: {error}") from None
    rig = rig_view({name: tables[name] for name in ("board", "camera") if name in tables}, str(path))
    if rig.board is None:
        raise CalibrationError(str(path), "[board] is missing")
    lens_file = rig.camera.lens_file if rig.camera is not None else None
    return RigFile(path, text, rig.board, path.parent / lens_file if lens_file is not None else None)


def free_name(path: Path) -> Path:
    """An unused name beside the file."""
    number, kept = 1, path.with_name(f"{path.name}.bak")
    while kept.exists() or kept.is_symlink():
        number += 1
        kept = path.with_name(f"{path.name}.bak-{number}")
    return kept
