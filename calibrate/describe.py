"""Text for `calibrate show` and `calibrate diff`: what an artefact holds, and how another one differs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from brushloop.calibrate.artefact import Artefact, current, load_artefact
from brushloop.calibrate.board.intrinsics import LensFile
from brushloop.calibrate.board.register import Registration
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.fit.brush import BrushFit

KINDS: dict[str, type[Artefact]] = {
    "image_to_paper": Calibration,
    "focal_se_px": LensFile,
    "robot_to_paper": Registration,
    "edges_mm": BrushFit,
}
"""Each kind of artefact by a field that no other kind has."""


def read_any(path: Path) -> tuple[Path, Artefact]:
    """Read an artefact, or the calibration that a session uses; returns its path too. Raises `CalibrationError`."""
    if path.is_dir():
        used = current(path)
        if used is None:
            raise CalibrationError(str(path), f"is not calibrated: run `brushloop calibrate {path}`")
        path = used
    try:
        values: Any = json.loads(read_bounded(path))
    except (ValueError, RecursionError):
        raise CalibrationError(str(path), "is not an artefact: not JSON") from None
    kind = next((kind for name, kind in KINDS.items() if isinstance(values, dict) and name in values), None)
    if kind is None:
        raise CalibrationError(str(path), "is not an artefact of this software")
    return path, load_artefact(path, kind)


def described(artefact: Artefact) -> list[str]:
    """One line for each field by dotted name; the label of a calibration comes first."""
    label = [artefact.label] if isinstance(artefact, Calibration) and artefact.label else []
    return label + [f"{name} = {_short(value)}" for name, value in fields(artefact).items()]


def differences(one: Artefact, other: Artefact) -> list[str]:
    """One line for each field that differs, and for calibrations what that means in mm; empty where they are equal.

    Raises `CalibrationError` where they are of two kinds.
    """
    if type(one) is not type(other):
        problem = f"{type(one).__name__} and {type(other).__name__} are not compared"
        raise CalibrationError(f"{one.digest}, {other.digest}", problem)
    left, right = fields(one), fields(other)
    names = [*left, *(name for name in right if name not in left)]
    lines = [f"{n}: {_value_of(left, n)} -> {_value_of(right, n)}" for n in names if left.get(n) != right.get(n)]
    if lines and isinstance(one, Calibration) and isinstance(other, Calibration):
        lines += _meaning(one, other)
    return lines


def fields(artefact: Artefact) -> dict[str, object]:
    """Every value by its dotted name; tables are flattened."""
    return dict(_flat("", artefact.model_dump(mode="json")))


def _flat(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict) and value:
        for key, inner in cast("dict[str, object]", value).items():
            yield from _flat(f"{name}.{key}" if name else key, inner)
    else:
        yield name, value


def _meaning(one: Calibration, other: Calibration) -> Iterator[str]:
    apart = other.mm_per_px_low > one.mm_per_px_high or one.mm_per_px_low > other.mm_per_px_high
    verdict = "their intervals lie apart" if apart else "their intervals overlap"
    yield f"pix2len differs by {100.0 * (other.mm_per_px / one.mm_per_px - 1.0):+.4f} %, {verdict}"
    x, y = one.board.origin_mm
    width, height = (n * one.board.square_mm for n in one.board.squares)
    across, along = np.meshgrid(np.linspace(x, x + width, 9), np.linspace(y, y + height, 9))
    paper_mm = np.column_stack([across.ravel(), along.ravel()])
    off_mm = np.linalg.norm(other.to_paper(one.to_image(paper_mm)) - paper_mm, axis=1)
    yield f"the same pixel lies {off_mm.mean():.3f} mm apart on average over the board, {off_mm.max():.3f} mm at most"


def _value_of(values: dict[str, object], name: str) -> str:
    return _short(values[name]) if name in values else "none"


def _short(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 200 else text[:197] + "..."
