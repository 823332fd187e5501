"""A practice sheet can be drawn by the rig, and its ink becomes the footprint that plans lead the brush by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.commands import PracticeRequest
from brushloop.calibrate.writing import FootprintArtefact
from brushloop.calibrate.writing.learn import (
    FIGURES,
    MARGIN,
    fitted,
    practice,
    practice_strokes,
)
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.model.characters.plan import Reach, grid, without_tilt
from brushloop.model.drag import NAMES, Drawings, Footprint, inked

SIDE_MM = 70.0


def test_a_practice_sheet_is_a_protocol_that_stays_inside_its_cells(tmp_path: Path) -> None:
    protocol = load_protocol(practice(PracticeRequest(tmp_path)).path)
    assert isinstance(protocol, WriteConfig)
    assert len(protocol.figures) == FIGURES
    points = np.concatenate([np.array(stroke.points) for one in protocol.figures for stroke in one.strokes])
    assert points[:, :2].min() >= MARGIN * SIDE_MM - 1e-3
    assert points[:, :2].max() <= (1.0 - MARGIN) * SIDE_MM + 1e-3
    assert points[:, 2].max() <= 14.0


def test_figures_become_a_footprint() -> None:
    true = Footprint(tuple({**dict(zip(NAMES, Footprint().values, strict=True)), "half_mm_2": 0.8}.values()))
    paths = [without_tilt(stroke) for stroke in practice_strokes(SIDE_MM, Reach(), 34.0)[:4]]
    x_mm, y_mm = grid(SIDE_MM, 70)
    ink = np.array([inked([true] * 2, paths[k : k + 2], x_mm, y_mm) > 0.0 for k in (0, 2)], np.float32)
    footprint, csim_percent = fitted(Drawings(paths, np.array([0, 2, 4]), ink, x_mm, y_mm))
    assert csim_percent > 95.0
    values = dict(zip(NAMES, footprint.values, strict=True))
    about = {"session_id": "practice-01", "source": "loopback rig", "recording_sha256": "", "calibration": ""}
    fields = about | {"software": "test", "images": 2, "strokes": 4, "csim_percent": csim_percent}
    assert FootprintArtefact.model_validate(fields | {"values": values}).footprint() == footprint
    with pytest.raises(ValueError, match="fit the session again with `brushloop write fit`"):
        FootprintArtefact.model_validate(fields | {"values": {"drift_along_mm": 0.0}})
