"""A calibration is a file named after its contents: equal inputs give an equal file, an edited one is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibrate.artefact import Calibration, load_artefact, newest
from calibrate.errors import CalibrationError

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
)


def test_it_reads_back_as_it_was_and_saving_again_changes_nothing(tmp_path: Path) -> None:
    path = MADE.save(tmp_path)
    before = path.stat().st_mtime_ns
    assert load_artefact(path, Calibration) == MADE
    assert MADE.save(tmp_path) == path
    assert path.stat().st_mtime_ns == before
    assert [p.name for p in tmp_path.iterdir()] == [f"{MADE.digest}.json"]


def test_another_number_is_another_file(tmp_path: Path) -> None:
    other = MADE.model_copy(update={"mm_per_px": 0.17})
    assert MADE.save(tmp_path) != other.save(tmp_path)


def test_an_edited_file_is_refused(tmp_path: Path) -> None:
    path = MADE.save(tmp_path)
    path.write_text(path.read_text().replace("loopback rig", "real capture"))
    with pytest.raises(CalibrationError, match="was edited"):
        load_artefact(path, Calibration)


@pytest.mark.parametrize("text", ["", "{}", "[1, 2]", '{"schema_version": "x"}'])
def test_what_is_no_artefact_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(CalibrationError) as refused:
        load_artefact(tmp_path / "x.json", Calibration)
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value)


def test_the_newest_is_the_one_written_last(tmp_path: Path) -> None:
    assert newest(tmp_path) is None
    MADE.save(tmp_path / "calibration")
    last = MADE.model_copy(update={"rms_px": 0.1}).save(tmp_path / "calibration")
    assert newest(tmp_path) == last
