"""An artefact is a file named after its contents: equal inputs give an equal file, an edited one is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from brushloop.calibrate.artefact import current, load_artefact, put_to_use
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from tests.calibrate.given import CALIBRATION


def made(rms_px: float) -> Calibration:
    return CALIBRATION.model_copy(update={"rms_px": rms_px})


def test_it_reads_back_as_it_was_and_an_edited_one_is_refused(tmp_path: Path) -> None:
    path = CALIBRATION.save(tmp_path)
    before = path.stat().st_mtime_ns
    assert load_artefact(path, Calibration) == CALIBRATION
    assert CALIBRATION.save(tmp_path) == path
    assert path.stat().st_mtime_ns == before
    assert [p.name for p in tmp_path.iterdir()] == [f"{CALIBRATION.digest}.json"]
    assert made(0.3).save(tmp_path) != path
    path.write_text(path.read_text().replace("loopback rig", "real capture"))
    with pytest.raises(CalibrationError, match="was edited"):
        load_artefact(path, Calibration)


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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "is missing: choose with `brushloop calibrate apply"),
        ("", "holds no name of an artefact"),
        ("../../secret.json", "holds no name of an artefact"),
        ("0123456789abcdef.json\n0123456789abcdef.json", "holds no name of an artefact"),
        ("x" * 1000, "is larger than 256 bytes"),
        ("0123456789abcdef.json", "names 0123456789abcdef.json, which is not there: choose with `brushloop calibrate"),
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
    with pytest.raises(CalibrationError, match=re.escape(message)) as refused:
        current(tmp_path)
    assert "\n" not in str(refused.value)
    assert put_to_use(CALIBRATION, tmp_path) == path == current(tmp_path), "calibrating again mends it"
