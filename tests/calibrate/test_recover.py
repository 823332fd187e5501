"""Presses of a session come back as a CSV and a protocol that the rig can press again, with honest intervals."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest

from brushloop.calibrate.commands import RecoverRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.recover import (
    NO_MODEL_ERROR,
    NOT_INFORMATIVE,
    PROTOCOL,
    Recovered,
    Row,
    common_variance,
    covers_most,
    model_sd,
    recover,
    with_model_error,
)
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import ListConfig
from brushloop.model.ccdbsm import Brush, ccdbsm
from brushloop.model.raster import coverage
from brushloop.sessions.records import Condition
from tests.calibrate.given import rows_of
from tests.command import said
from tests.photographed import imported

PRESSES = [(12.0, 3.0), (15.0, 6.0), (18.5, 9.0)]
PX = 12.0  # of the pretended scan, per mm
START = (34.0, 20.0)  # mm from the left and top edge


def photograph(depth_mm: float, tilt_deg: float, start_x_mm: float = START[0]) -> np.ndarray:
    """A 50 x 40 mm photograph at 12 px/mm of CCD-BSM's own mark, touched at START, ferrule to the right."""
    origin = (start_x_mm + depth_mm * math.tan(math.radians(tilt_deg)), START[1])
    ink = coverage(ccdbsm(Brush(), depth_mm, tilt_deg).outline(), origin, size_px=600, px_mm=1 / PX)[0][:480]
    return np.rint(230.0 * (1.0 - 0.92 * ink)).astype(np.uint8)


def session(
    folder: Path, *, kind: Literal["press", "drag"] = "press", start_x_mm: float = START[0], mirrored: bool = False
) -> Path:
    photos = folder / "photos"
    photos.mkdir(parents=True)
    lines = ["file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"]
    for k, (height, tilt) in enumerate(PRESSES):
        image = photograph(height, tilt, start_x_mm)
        cv2.imwrite(str(photos / f"p{k}.png"), image[:, ::-1] if mirrored else image)
        x_mm = image.shape[1] / PX - start_x_mm if mirrored else start_x_mm
        lines.append(f"p{k}.png,{height},{tilt},{PX},{x_mm * PX},{START[1] * PX}")
    return imported(photos, lines, folder / "sessions" / "shots", kind)


def recovered(session: Path, out: Path, **options: Any) -> Recovered:
    return recover(RecoverRequest(session, out / "recovered.csv", **options))


def test_a_session_is_inverted_and_can_be_replayed(tmp_path: Path) -> None:
    out = tmp_path / "out" / "recovered.csv"
    words = said("recover", session(tmp_path), "--out", out)
    assert "3 presses recovered by CCD-BSM as published (imported photographs)" in words
    assert "H: recovered values are -0.0" in words
    assert "3 of 3 intervals (95 %) contain the commanded value" in words
    assert "warning: the intervals of 3 presses leave out the error of the model" in words
    protocol = load_protocol(out.with_name(PROTOCOL))
    assert isinstance(protocol, ListConfig)
    assert (protocol.of, [press.stroke_id for press in protocol.presses]) == ("shots", ["p0", "p1", "p2"])
    rows = rows_of(out)
    assert (rows[0]["commanded_depth_mm"], rows[0]["source"]) == ("12", "imported photographs")
    for row, press, (height, tilt) in zip(rows, protocol.presses, PRESSES, strict=True):
        # The preprocessing's own threshold is what is left: .03 mm of depth.
        assert float(row["depth_mm"]) == pytest.approx(height, abs=0.08)
        assert float(row["tilt_deg"]) == pytest.approx(tilt, abs=0.6)
        assert 0 < float(row["depth_sd_mm"]) < 0.2
        assert press.depth_mm == pytest.approx(float(row["depth_mm"]), abs=1e-3)
    few = recovered(tmp_path / "sessions" / "shots", tmp_path, presses=2)  # spread evenly over the session
    assert ([row.stroke_id for row in few.rows], few.left_out) == (["p0", "p1"], [])
    said("fit", few.session.recording.path)
    models = [recovered(few.session.recording.path, tmp_path, fit=fit).model for fit in (None, Path("published"))]
    assert models == ["CCD-BSM fitted on shots", "CCD-BSM as published"], "the fit in use, unless told otherwise"


def test_what_cannot_be_inverted_is_refused_and_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "drags").mkdir()
    with pytest.raises(CalibrationError, match="holds drags"):
        recovered(session(tmp_path / "drags", kind="drag"), tmp_path)
    with pytest.raises(CalibrationError, match="no stroke could be recovered: p0: is cut by the edge of its photo"):
        recovered(session(tmp_path, start_x_mm=8.0), tmp_path)
    with pytest.raises(CalibrationError, match="p0: lies to the right of its touch point"):
        recovered(session(tmp_path / "turned", mirrored=True), tmp_path)
    with pytest.raises(CalibrationError, match=r"no depth and tilt that this brush can press: depth_mm = \(2, 2\)"):
        recovered(tmp_path / "sessions" / "shots", tmp_path, depth_range_mm=(2.0, 2.0))
    with pytest.raises(CalibrationError, match=r"must end in \.csv"):
        recover(RecoverRequest(tmp_path, tmp_path / PROTOCOL))
    assert not (tmp_path / "recovered.csv").exists()


CONDITIONS = [Condition(h, a) for h in (11.0, 13.0, 15.0, 17.0, 20.0) for a in (0.0, 5.0, 10.0)]


def rows(conditions: list[Condition], error_mm: float, error_deg: float) -> list[Row]:
    rng = np.random.default_rng(0)
    return [
        Row(f"s{k}", one, one.depth_mm + error_mm * rng.normal(), one.tilt_deg + error_deg * rng.normal(), 0.05, 0.2, 0)
        for k, one in enumerate(conditions * 20)
    ]


def inside(made: list[Row]) -> float:
    return float(np.mean([abs(off) <= 1.96 * sd for off, sd in (row.off["alpha"] for row in made)]))


def test_a_model_error_is_in_the_interval_and_weighs_more_where_the_brush_is_pressed_less() -> None:
    raw = rows(CONDITIONS, 0.3, 2.0)
    made = with_model_error(raw)
    assert inside(raw) < 0.3
    assert 0.93 <= inside(made) <= 0.99
    shallow, deep = ([r.tilt_sd_deg for r in made if r.commanded.depth_mm == h] for h in (11.0, 20.0))
    assert np.mean(shallow) == pytest.approx(np.mean(deep) * 20.0 / 11.0, rel=0.1)


def test_the_own_command_does_not_enter_the_interval() -> None:
    off = np.array([5.0, 0.1, 0.1, 0.1])
    found = model_sd(off, np.full(4, 0.01), [Condition(h, 0.0) for h in (11.0, 13.0, 15.0, 17.0)])
    assert found[0] == pytest.approx(0.1 * 3.182 / 1.96, rel=0.02)
    assert found[1] > 3.0


def test_a_condition_the_brush_was_not_fitted_to_takes_the_error_of_such_conditions() -> None:
    conditions = CONDITIONS[:9]
    off = np.array([0.1] * 5 + [1.0] * 4)
    sd = np.full(9, 0.01)
    found = model_sd(off, sd, conditions, fitted=conditions[:5])
    assert found[5:] == pytest.approx(1.0 * 3.182 / 1.96, rel=0.01), "three other conditions left out"
    assert (model_sd(off, sd, conditions)[5:] < 1.0).all(), "diluted by the fitted conditions"
    alone = model_sd(off[:6], sd[:6], conditions[:6], fitted=conditions[:5])[5:]
    assert (alone < 0.2).all(), "none else left out: all conditions"


def test_a_press_that_its_image_hardly_determines_counts_little() -> None:
    off, sd = np.array([0.5, -0.5, 0.5, 3.0]), np.array([0.01, 0.01, 0.01, 30.0])
    assert common_variance(off, sd) == pytest.approx(0.25 * 3 / 4, rel=0.1)
    assert common_variance(np.array([0.1, 0.1]), np.array([0.5, 0.5])) == 0.0


def test_too_few_conditions_and_intervals_over_most_of_the_commanded_range_are_flagged() -> None:
    assert all(NO_MODEL_ERROR in row.flags for row in with_model_error(rows(CONDITIONS[:3], 0.3, 2.0)))
    vague, sharp = (with_model_error(rows(CONDITIONS, 0.3, error_deg)) for error_deg in (4.0, 0.5))
    assert any(NOT_INFORMATIVE["alpha"] in row.flags and row.tilt_sd_deg > 3.0 for row in vague)
    assert not any(row.flags & set(NOT_INFORMATIVE.values()) for row in sharp)
    for value, sd, most in ((5.0, 2.5, True), (5.0, 1.5, False), (0.0, 2.5, False)):
        assert covers_most(value, sd, [0.0, 5.0, 10.0]) is most
        assert not covers_most(value, sd, [5.0, 5.0]), "one tilt only: there is no range to compare with"


def test_upright_presses_recovered_at_0_do_not_count_as_exact() -> None:
    half = [replace(r, tilt_deg=max(r.tilt_deg, 0.0)) for r in rows(CONDITIONS[::3], 0.3, 2.0)]
    assert np.mean([r.tilt_deg == 0.0 for r in half]) > 0.4
    assert np.mean([r.tilt_sd_deg for r in with_model_error(half)]) > 1.9
