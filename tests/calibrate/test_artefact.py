"""A calibration is a file named after its contents: equal inputs give an equal file, an edited one is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from brushloop.calibrate.artefact import current, load_artefact, put_to_use
from brushloop.calibrate.board.lens import unknown_lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError

MADE = Calibration(
    session_id="2026-01-02-grid-01",
    source="loopback rig",
    recording_sha256="ab" * 32,
    software="brushloop test",
    image_to_paper=(0.16, 0.0, -40.0, 0.0, -0.16, 200.0, 0.0, 0.0, 1.0),
    mm_per_px=0.16,
    mm_per_px_low=0.1599,
    mm_per_px_high=0.1601,
    rms_px=0.2,
    corners=159,
    corners_dropped=0,
    preprocess={"contrast_gate": 0.25},
    lens=unknown_lens((640, 480)),
    middle_px=(0.0, 0.0),
    board=BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, origin_mm=(0.0, 0.0)),
    still_sha256="",
)


def test_it_reads_back_as_it_was_and_saving_again_changes_nothing(tmp_path: Path) -> None:
    path = MADE.save(tmp_path)
    before = path.stat().st_mtime_ns
    assert load_artefact(path, Calibration) == MADE
    assert MADE.save(tmp_path) == path
    assert path.stat().st_mtime_ns == before
    assert [p.name for p in tmp_path.iterdir()] == [f"{MADE.digest}.json"]
    assert made(0.3).save(tmp_path) != path


def test_an_edited_file_is_refused(tmp_path: Path) -> None:
    path = MADE.save(tmp_path)
    path.write_text(path.read_text().replace("loopback rig", "real capture"))
    with pytest.raises(CalibrationError, match="was edited"):
        load_artefact(path, Calibration)


def made(rms_px: float) -> Calibration:
    return MADE.model_copy(update={"rms_px": rms_px})


def test_what_was_put_to_use_last_is_in_use_and_no_artefact_changes(tmp_path: Path) -> None:
    """Lens A, lens B, lens A again."""
    assert current(tmp_path) is None
    a, b = put_to_use(made(0.1), tmp_path), put_to_use(made(0.2), tmp_path)
    assert current(tmp_path) == b
    assert current(tmp_path, "brushfit") is None, "each kind has a pointer of its own"
    before = {path: path.stat().st_mtime_ns for path in (a, b)}
    assert put_to_use(made(0.1), tmp_path) == a == current(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (a, b)} == before
    a.touch()
    b.touch()
    assert current(tmp_path) == a, "no matter what a copy or a backup did to the times"
    assert sorted(path.name for path in a.parent.iterdir()) == sorted([a.name, b.name, "current"])


def test_artefacts_without_a_pointer_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "calibration"
    MADE.save(folder)
    with pytest.raises(CalibrationError, match="is missing: choose with `brushloop calibrate apply"):
        current(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no name of an artefact"),
        ("../../secret.json", "holds no name of an artefact"),
        ("0123456789abcdef.json\n0123456789abcdef.json", "holds no name of an artefact"),
        ("x" * 1000, "is larger than 256 bytes"),
        ("0123456789abcdef.json", "names 0123456789abcdef.json, which is not there: choose with `brushloop calibrate"),
    ],
    ids=["empty", "elsewhere", "two", "long", "missing"],
)
def test_a_pointer_that_leads_nowhere_is_refused_and_never_guessed_around(
    tmp_path: Path, text: str, message: str
) -> None:
    path = put_to_use(MADE, tmp_path)
    (path.parent / "current").write_text(text)
    with pytest.raises(CalibrationError, match=re.escape(message)) as refused:
        current(tmp_path)
    assert "\n" not in str(refused.value)
    assert put_to_use(MADE, tmp_path) == path == current(tmp_path), "calibrating again mends it"
