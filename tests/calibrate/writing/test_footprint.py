"""A practice sheet can be drawn by the rig, and its ink becomes the footprint that plans lead the brush by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.drags.captures import Drawn
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing import learn
from brushloop.calibrate.writing.learn import (
    FIGURES,
    FOLDER,
    MARGIN,
    FootprintArtefact,
    PracticeRequest,
    fit,
    practice,
    practice_strokes,
)
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.write import WriteConfig
from brushloop.model.characters.plan import Reach, without_tilt
from brushloop.model.drag import NAMES, Drawings, Footprint
from brushloop.sessions.records import Header, Source
from tests.calibrate.given import CALIBRATION
from tests.command import brushloop

SIDE_MM = 70.0


def test_a_practice_sheet_is_a_protocol_that_stays_inside_its_cells(tmp_path: Path) -> None:
    protocol = load_protocol(practice(PracticeRequest(tmp_path)).path)
    assert isinstance(protocol, WriteConfig)
    assert len(protocol.figures) == FIGURES
    points = np.concatenate([np.array(stroke.points) for one in protocol.figures for stroke in one.strokes])
    assert points[:, :2].min() >= MARGIN * SIDE_MM - 1e-3
    assert points[:, :2].max() <= (1.0 - MARGIN) * SIDE_MM + 1e-3
    assert points[:, 2].max() <= 14.0
    again, other = (practice_strokes(SIDE_MM, Reach(), 48.0, seed)[0] for seed in (1, 2))
    assert np.array_equal(again, practice_strokes(SIDE_MM, Reach(), 48.0, 1)[0])
    assert not np.array_equal(again[:2], other[:2])


def test_a_session_of_practice_becomes_a_footprint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    true = Footprint(tuple({**dict(zip(NAMES, Footprint().values, strict=True)), "half_mm_2": 0.8}.values()))
    strokes = practice_strokes(SIDE_MM, Reach(), 34.0)[:4]
    x_mm = (np.arange(70) + 0.5) * SIDE_MM / 70
    y_mm = SIDE_MM - x_mm
    paths = [without_tilt(stroke) for stroke in strokes]
    ink = np.array([true.distance(paths[k : k + 2], x_mm, y_mm) > 0.0 for k in (0, 2)], np.float32)

    def drawn(count: int) -> Drawn:
        header = Header(session_id="practice-01", source=Source.LOOPBACK, software="test")
        names = ["practice-01-r01", "practice-02-r01"][:count]
        groups = np.array([0, 2, 4])[: count + 1]
        drawings = Drawings(paths[: 2 * count], groups, ink[:count], x_mm, y_mm, np.ones(count))
        return Drawn(header, "ab", CALIBRATION, drawings, names, [], None, [()] * count, "")

    monkeypatch.setattr(learn, "read_drags", lambda *_, **__: drawn(2))
    path = fit(tmp_path).path
    assert path.parent == tmp_path / FOLDER
    artefact = load_artefact(path, FootprintArtefact)
    assert artefact.source == "loopback rig"
    assert artefact.strokes == 4
    assert artefact.csim_percent > 95.0
    older = artefact.model_dump() | {"values": {"drift_along_mm": 0.0}}
    with pytest.raises(ValueError, match="fit the session again with `brushloop write fit`"):
        FootprintArtefact.model_validate(older)
    monkeypatch.setattr(learn, "read_drags", lambda *_, **__: drawn(1))
    with pytest.raises(CalibrationError, match="holds 2 strokes, at least 3 are needed"):
        fit(tmp_path)


def test_a_file_that_is_no_footprint_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "0123456789abcdef.json").write_text("{}", encoding="utf-8")
    ran = brushloop("write", "plan", "子", "--footprint", "0123456789abcdef.json", cwd=tmp_path)
    assert ran.returncode == 2
    assert "0123456789abcdef.json" in ran.stderr
    assert not (tmp_path / "write-plan").exists()
