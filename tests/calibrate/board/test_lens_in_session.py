"""A camera that distorts: the session's lens, or a given one, is undone first; without one the error names the remedy.

Loopback rig, its barrel camera (k1 = -0.15).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.board.lens import read_lens
from brushloop.calibrate.board.pix2len import see_board
from brushloop.calibrate.calibrated import calibrate_session as calibrate
from brushloop.calibrate.commands import CalibrateRequest
from brushloop.calibrate.compare import MM_PER_PX, field_around
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.presses import prepare_press
from brushloop.calibrate.session import Calibration
from brushloop.calibrate.stroke import PX_PER_MM
from brushloop.collect.tui.review_screen import Review
from brushloop.sessions.errors import InputError
from brushloop.sessions.recording import Recording
from tests.calibrate.given import kept_lens
from tests.calibrate.simulated_rigs import CAMERAS, Shot, collected, sheet, true_mask, true_scale

BARREL = 3
WORST_SCALE = 2e-4
WORST_ANCHOR_MM = 0.1


def rig_lens(folder: Path, k1: float, size_px: tuple[int, int] = (2048, 1536)) -> Path:
    """A lens file for a rig's camera, a little off in focus and centre."""
    return kept_lens(folder, size_px, k1 + 0.002, size_px[0] + 1.0, (0.5, -0.5))


@pytest.fixture(scope="module")
def shot() -> Shot:
    return sheet(BARREL, 2)


@pytest.fixture(scope="module")
def lens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig_lens(tmp_path_factory.mktemp("lens"), CAMERAS[BARREL].k1)


def calibrate_session(session: Path, lens: Path | None = None) -> Calibration:
    return calibrate(CalibrateRequest(session, lens)).calibration


def holds(made: Calibration, shot: Shot) -> None:
    """Scale within 2e-4 and inside its interval, anchors within 0.1 mm."""
    truth = true_scale(shot, made.middle_px)
    assert made.mm_per_px == pytest.approx(truth, rel=WORST_SCALE)
    assert made.mm_per_px_low <= truth <= made.mm_per_px_high
    anchors = np.array(shot.anchors_mm)
    off_px = np.linalg.norm(made.to_image(anchors) - shot.optics.image_of(anchors), axis=1)
    assert off_px.max() * truth <= WORST_ANCHOR_MM


def test_a_bent_session_is_refused_without_a_lens_file_which_makes_scale_anchors_and_masks_right(
    tmp_path: Path, shot: Shot, lens: Path
) -> None:
    session = collected(tmp_path / "bent", shot)
    with pytest.raises(
        CalibrationError, match=r"bent by .* px: .*`brushloop camera intrinsics`.* in rig.toml, .*--lens"
    ):
        calibrate_session(session)
    assert not (session / "calibration").exists()
    ran = CliRunner().invoke(app, ["calibrate", str(session), "--lens", str(lens)])
    assert ran.exit_code == 0, ran.output
    assert f"lens: lens file {lens.stem}" in ran.output
    path = current(session)
    assert path is not None
    made = load_artefact(path, Calibration)
    holds(made, shot)
    assert made.lens.source == f"lens file {lens.stem}"
    assert made.lens.distortion[0] == pytest.approx(CAMERAS[BARREL].k1, abs=0.005)
    assert made.board == shot.board
    assert len(made.still_sha256) == len(made.recording_sha256) == 64

    for capture in Recording(session).captures():
        assert capture.stroke.anchor_mm is not None
        mask = prepare_press(capture, made).mask
        truth = true_mask(shot, field_around(capture.stroke.anchor_mm), PX_PER_MM)
        # The cell of the model's field may end in the middle of the stroke's neighbour; here there is none.
        assert (mask & truth).sum() / (mask | truth).sum() >= 0.95
    small = made.model_copy(update={"lens": made.lens.model_copy(update={"size_px": (1024, 768)})})
    with pytest.raises(CaptureRefused, match="is 2048 x 1536 px, the lens was calibrated at 1024 x 768 px"):
        prepare_press(capture, small)


def test_a_session_that_was_collected_with_a_lens_needs_no_other(tmp_path: Path, shot: Shot, lens: Path) -> None:
    session = collected(tmp_path / "own", shot, read_lens(lens))
    holds(calibrate_session(session), shot)
    for given, why in (
        (rig_lens(tmp_path / "wrong", 0.08), r"bent by .* of another camera, or of another focus"),
        (rig_lens(tmp_path / "small", -0.15, (1024, 768)), "is 2048 x 1536 px, the lens was calibrated at 1024 x 768"),
        (tmp_path / "nosuch.json", "no such file"),
    ):
        with pytest.raises(InputError, match=why):
            calibrate_session(session, given)


def test_the_quick_look_at_a_board_knows_a_lens_too(shot: Shot, lens: Path) -> None:
    with pytest.raises(CalibrationError, match="the lens bends straight lines: calibrate it with `brushloop camera"):
        see_board(shot.image, shot.board)
    known = read_lens(lens)
    plane = see_board(shot.image, shot.board, lens=known)
    again = see_board(known.undistort(shot.image), shot.board)
    assert plane.rms_px < 0.3
    assert again.mm_per_px == pytest.approx(plane.mm_per_px, rel=2e-4)
    with pytest.raises(CalibrationError, match="the lens was calibrated at 2048 x 1536 px"):
        see_board(np.ascontiguousarray(shot.image[:, :-8]), shot.board, lens=known)


def test_the_review_looks_through_the_recorded_lens_or_says_why_not(tmp_path: Path, shot: Shot, lens: Path) -> None:
    session = collected(tmp_path / "own", shot, read_lens(lens))
    review = Review(session)
    assert review.shown_whole == ""
    for seen in review.captures:
        looked = review.pictures(seen)
        assert looked.binary is not None
        assert looked.photo.shape == (768, 768), "the field, not the whole photograph"
        anchor = shot.anchors_mm[review.captures.index(seen)]
        truth = true_mask(shot, field_around(anchor), 1.0 / MM_PER_PX)
        assert (looked.binary & truth).sum() / (looked.binary | truth).sum() >= 0.9
    (session / "rig.effective.json").write_text('{"board": 7}')
    review = Review(session)
    assert "rig.effective.json: board: Input should be" in review.shown_whole
    assert review.pictures(review.captures[0]).photo.shape == shot.image.shape
