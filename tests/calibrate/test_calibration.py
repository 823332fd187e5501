"""`brushloop calibrate`, also through a lens; and artefacts: files named after their contents, one of them in use."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.artefact import HASH_CHARS, current, put_to_use
from brushloop.calibrate.board.lens import FITTED, read_lens
from brushloop.calibrate.board.pix2len import see_board
from brushloop.calibrate.calibrated import calibrate_session
from brushloop.calibrate.commands import CalibrateRequest
from brushloop.calibrate.compare import MM_PER_PX, field_around
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.presses import prepare_press
from brushloop.calibrate.session import Calibration, open_session
from brushloop.calibrate.stroke.preprocess import PX_PER_MM
from brushloop.collect.photograph.measure import blur_px, busiest_tile
from brushloop.collect.tui.review_screen import Review
from brushloop.sessions.errors import InputError
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke
from tests.calibrate.given import CALIBRATION, iou, kept_lens, photographed
from tests.calibrate.simulated_rigs import CAMERAS, Shot, boards, collected, sheet, true_mask, true_scale
from tests.command import brushloop, refused, said
from tests.photographed import imported_presses


@pytest.fixture(scope="module")
def blank() -> Shot:
    """A sheet without ink on the board, at half the resolution of the camera."""
    [shot] = boards(0, 1)
    return dataclasses.replace(shot, image=cv2.pyrDown(shot.image))


def test_half_a_board_is_flagged(tmp_path: Path, blank: Shot) -> None:
    half = blank.image.copy()
    half[:, :614] = 70
    for image, warned in ((half, True), (blank.image, False)):
        session = photographed(tmp_path / f"warned-{warned}", blank.board, [image], sheet_mm=blank.sheet_mm)
        made = calibrate_session(CalibrateRequest(session))
        assert ("warning: only" in made.lines()[0]) is warned
        assert any("partly hidden" in flag for flag in made.calibration.flags) is warned
        assert f"lens: {FITTED}" in made.lines()
        assert Calibration.read(made.path) == made.calibration


def test_a_camera_that_was_touched_before_the_last_view_of_the_board_is_said(tmp_path: Path, blank: Shot) -> None:
    off_px = 6
    photographs = [np.roll(blank.image, off_px, axis=1), np.full_like(blank.image, 220), blank.image, blank.image]
    session = photographed(tmp_path / "moved", blank.board, photographs, sheet_mm=blank.sheet_mm)
    made = calibrate_session(CalibrateRequest(session))
    touched, unseen = made.moved
    lay = f"{off_px}.0 px ({off_px * made.calibration.mm_per_px:.2f}"
    assert touched.startswith(f"3 min before the last photograph of the board, the board lay {lay}")
    assert unseen.startswith("2 min before the last photograph of the board, the board is not seen: is blank")


def test_what_has_no_board_cannot_be_calibrated(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="holds no photograph of the board"):
        calibrate_session(CalibrateRequest(photographed(tmp_path / "none", CALIBRATION.board, [])))
    with pytest.raises(CalibrationError, match="is an import and has its own scale"):
        calibrate_session(CalibrateRequest(imported_presses(tmp_path, [(11.0, 0.0)])))


def test_the_calibration_of_another_session_is_refused(tmp_path: Path, blank: Shot) -> None:
    press = Stroke(stroke_id="s", kind="press", still=0, anchor_mm=(100.0, 80.0)), blank.image
    one, other = (photographed(tmp_path / name, blank.board, [blank.image], [press]) for name in ("one", "other"))
    made = calibrate_session(CalibrateRequest(one))
    shutil.copytree(made.path.parent, other / "calibration")
    with pytest.raises(CalibrationError, match=r"belongs to another recording \(one\)"):
        open_session(other)


def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    tmp_path: Path, blank: Shot, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = photographed(tmp_path / "s", blank.board, [blank.image], sheet_mm=blank.sheet_mm)
    write_bytes = Path.write_bytes

    def half_of_it(path: Path, data: bytes) -> int:
        write_bytes(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half_of_it)
    ran = brushloop("calibrate", session)
    assert (ran.returncode, ran.stdout) == (4, "")
    assert re.fullmatch(r"brushloop: .*/calibration/\w+\.json: No space left on device\n", ran.stderr)
    assert list((session / "calibration").iterdir()) == []


def artefact(rms_px: float) -> Calibration:
    return CALIBRATION.model_copy(update={"rms_px": rms_px})


def test_an_artefact_is_named_after_its_contents(tmp_path: Path) -> None:
    path = CALIBRATION.save(tmp_path)
    assert Calibration.read(path) == CALIBRATION
    assert [p.name for p in tmp_path.iterdir()] == [f"{CALIBRATION.digest}.json"]
    path.write_text(path.read_text().replace("loopback rig", "real capture"))
    with pytest.raises(CalibrationError, match="was edited"):
        Calibration.read(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no json", "is not JSON"),
        ('{"session_id": "s"}', "image_to_paper: Field required"),
        (CALIBRATION.model_dump_json().replace('"schema_version":4', '"schema_version":5'), "schema_version: Input"),
    ],
    ids=["words", "half", "of later"],
)
def test_what_is_no_artefact_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / f"{hashlib.sha256(text.encode()).hexdigest()[:HASH_CHARS]}.json"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        Calibration.read(path)
    assert "\n" not in str(refused.value)


def test_what_was_put_to_use_last_is_in_use_and_no_artefact_changes(tmp_path: Path) -> None:
    """Lens A, lens B, lens A again."""
    assert current(tmp_path) is None
    a, b = put_to_use(artefact(0.1), tmp_path), put_to_use(artefact(0.2), tmp_path)
    assert current(tmp_path) == b
    assert current(tmp_path, "brushfit") is None, "each kind has a pointer of its own"
    before = {path: path.stat().st_mtime_ns for path in (a, b)}
    assert put_to_use(artefact(0.1), tmp_path) == a == current(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (a, b)} == before
    b.touch()
    assert current(tmp_path) == a, "no matter what a copy or a backup did to the times"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "is missing: calibrate or fit"),
        ("", "does not hold the name of an artefact"),
        ("../../secret.json", "does not hold the name of an artefact"),
        ("0123456789abcdef.json\n0123456789abcdef.json", "does not hold the name of an artefact"),
        ("x" * 1000, "is larger than 256 bytes"),
        ("0123456789abcdef.json", "names 0123456789abcdef.json, which is missing: calibrate"),
    ],
    ids=["none", "empty", "elsewhere", "two", "long", "missing"],
)
def test_a_pointer_that_leads_nowhere_is_refused_and_never_guessed_around(
    tmp_path: Path, text: str | None, message: str
) -> None:
    path = put_to_use(CALIBRATION, tmp_path)
    pointer = path.parent / "current"
    if text is None:
        pointer.unlink()
    else:
        pointer.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        current(tmp_path)
    assert "\n" not in str(refused.value)
    assert put_to_use(CALIBRATION, tmp_path) == path == current(tmp_path), "calibrating again mends it"


# Nothing that was recorded or is being read is ever overwritten


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("write", "plan", "字", "--out", "taken/plan"), "taken: is a file"),
        (("write", "compare", "s.mcap", "--plan", "p", "--out", "taken"), "taken: is a file"),
        (("write", "learn", "s.mcap", "--plan", "p", "--out", "taken"), "taken: is a file"),
        (("repress", "compare", "s.mcap", "s.mcap", "--out", "taken/loop"), "taken: is a file"),
        (("recover", "s.mcap", "--out", "taken/recovered.csv"), "taken: is a file"),
        (("validate", "s.mcap", "--out", "taken/report"), "taken: is a file"),
        (("recover", "s.mcap", "--out", "s.mcap"), "must end in"),
    ],
)
def test_where_it_is_to_be_written_is_looked_at_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("taken", "s.mcap"):
        (tmp_path / name).write_text("kept")
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.calibrate.writing.planned_figure", None)  # not called: it takes minutes
        assert why in refused(*words)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"taken": "kept", "s.mcap": "kept"}


# A camera that distorts (the loopback rig's barrel camera): the session's lens, or a given one, is undone first

BARREL = 3
WORST_SCALE = 2e-4
WORST_INTERVAL = 5e-4
WORST_ANCHOR_MM = 0.1


def rig_lens(folder: Path, k1: float, size_px: tuple[int, int] = (2048, 1536)) -> Path:
    """A lens file for a rig's camera, a little off in focus and centre."""
    return kept_lens(folder, size_px, k1 + 0.002, off_px=0.5)


@pytest.fixture(scope="module")
def shot() -> Shot:
    return sheet(BARREL, 2)


@pytest.fixture(scope="module")
def lens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig_lens(tmp_path_factory.mktemp("lens"), CAMERAS[BARREL].k1)


def calibrated(session: Path, lens: Path | None = None) -> Calibration:
    return calibrate_session(CalibrateRequest(session, lens)).calibration


def holds(made: Calibration, shot: Shot) -> None:
    """Scale within 2e-4 and inside its narrow interval, anchors within 0.1 mm."""
    truth = true_scale(shot, made.middle_px)
    assert made.mm_per_px == pytest.approx(truth, rel=WORST_SCALE)
    assert made.mm_per_px_low <= truth <= made.mm_per_px_high
    assert made.relative_reach < WORST_INTERVAL
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
        calibrated(session)
    assert not (session / "calibration").exists()
    assert f"lens: lens file {lens.stem}" in said("calibrate", session, "--lens", lens)
    path = current(session)
    assert path is not None
    made = Calibration.read(path)
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
        assert iou(mask, truth) >= 0.95
    small = made.model_copy(update={"lens": made.lens.model_copy(update={"size_px": (1024, 768)})})
    with pytest.raises(CaptureRefused, match="is 2048 x 1536 px, the lens was calibrated at 1024 x 768 px"):
        prepare_press(capture, small)


def test_a_session_that_was_collected_with_a_lens_needs_no_other(tmp_path: Path, shot: Shot, lens: Path) -> None:
    session = collected(tmp_path / "own", shot, read_lens(lens))
    holds(calibrated(session), shot)
    for given, why in (
        (rig_lens(tmp_path / "wrong", 0.08), r"bent by .* of another camera, or of another focus"),
        (rig_lens(tmp_path / "small", -0.15, (1024, 768)), "is 2048 x 1536 px, the lens was calibrated at 1024 x 768"),
        (tmp_path / "nosuch.json", "no such file"),
    ):
        with pytest.raises(InputError, match=why):
            calibrated(session, given)


def test_the_quick_look_at_a_board_needs_a_picture_without_distortion(shot: Shot, lens: Path) -> None:
    with pytest.raises(CalibrationError, match="the lens bends straight lines: calibrate the lens"):
        see_board(shot.image, shot.board)
    flat = read_lens(lens).undistort(shot.image)
    plane = see_board(flat, shot.board).plane
    assert plane.mm_per_px == pytest.approx(true_scale(shot, plane.middle_px), rel=5e-4)
    sharp_px, flat_px = (blur_px(busiest_tile(image)) or 0.0 for image in (shot.image, flat))
    assert sharp_px > 0.5
    assert flat_px < sharp_px + 0.04, "it stays as sharp, as sharpness is judged in it"


def test_the_review_looks_through_the_recorded_lens_or_is_refused(tmp_path: Path, shot: Shot, lens: Path) -> None:
    session = collected(tmp_path / "own", shot, read_lens(lens))
    review = Review(session)
    for seen in review.captures:
        looked = review.pictures(seen)
        assert looked.binary is not None
        assert looked.photo.shape == (768, 768), "the field, not the whole photograph"
        anchor = shot.anchors_mm[review.captures.index(seen)]
        truth = true_mask(shot, field_around(anchor), 1.0 / MM_PER_PX)
        assert iou(looked.binary, truth) >= 0.9
    (session / "rig.effective.json").write_text('{"board": 7}')
    with pytest.raises(InputError, match=r"rig\.effective\.json: board: Input should be"):
        Review(session)
