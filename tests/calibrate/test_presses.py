"""Each press is found in its photograph once, and kept in the session's folder for every command."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from brushloop.calibrate import presses, work
from brushloop.calibrate.commands import FitRequest, ValidateRequest
from brushloop.calibrate.compare import ANCHOR_MM, FIELD_MM
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.fit import heldout
from brushloop.calibrate.fit.command import fit_press_session
from brushloop.calibrate.presses import Press, cut, too_thin, uncommanded
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.validate import run as validation
from brushloop.calibrate.validate.command import validate
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke
from tests.calibrate.given import CALIBRATION
from tests.photographed import imported, imported_presses
from tests.sessions.conftest import no_space

CONDITIONS = [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return imported_presses(tmp_path, CONDITIONS)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each kind of work was done, by the name of its function."""
    counts: Counter[str] = Counter()

    def count(module: ModuleType, name: str) -> None:
        do: Callable[[Any], work.Arrays] = getattr(module, name)

        def counting(job: object) -> work.Arrays:
            counts[name] += 1
            return do(job)

        monkeypatch.setattr(module, name, counting)

    for module, name in ((presses, "prepare_job"), (heldout, "refit"), (validation, "score_job")):
        count(module, name)
    return counts


def read(session: Path | OpenSession) -> list[Press]:
    opened = open_session(session) if isinstance(session, Path) else session
    return list(presses.read_presses(opened, [], uncommanded, cut, too_thin))


def same(one: Press, other: Press) -> bool:
    pictures = (one.images, other.images), (one.coverage, other.coverage)
    return all(np.array_equal(*pair) for pair in pictures) and one.measured == other.measured


def test_fit_and_validate_do_no_work_twice(session: Path, tmp_path: Path, calls: Counter[str]) -> None:
    models = ("ccd-bsm", "ccd-bsm-heldout")
    request = ValidateRequest(places=(session,), models=models, out=tmp_path / "report")
    fit_press_session(FitRequest(session))
    validate(request)
    assert (calls["prepare_job"], calls["refit"], calls["score_job"]) == (3, 3, 3)
    fit_press_session(FitRequest(session))
    validate(request)
    assert calls.total() == 9


def test_what_a_press_depends_on_makes_it_anew(
    session: Path, tmp_path: Path, calls: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = read(session)
    assert [press.stroke.depth_mm for press in first] == [11.0, 15.0, 20.0]
    assert all(map(same, first, read(session)))
    assert calls["prepare_job"] == 3

    for calibration in (CALIBRATION, CALIBRATION.model_copy(update={"rms_px": 0.3})):
        read(replace(open_session(session), calibration=calibration))
    assert calls["prepare_job"] == 9, "other calibrations"
    monkeypatch.setattr(work, "VERSION", "of tomorrow")
    read(session)
    assert calls["prepare_job"] == 12, "other software"

    photograph = tmp_path / "presses-photos" / "0.png"
    image = cv2.imread(str(photograph), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(photograph), np.roll(image, 10, axis=1))
    lines = (tmp_path / "presses-photos" / "strokes.csv").read_text().splitlines()
    other = imported(tmp_path / "presses-photos", lines, tmp_path / "other", "press")
    shutil.copytree(session / work.FOLDER, other / work.FOLDER)
    assert not same(first[0], read(other)[0])
    assert calls["prepare_job"] == 15, "another photograph"


def test_damaged_large_and_lost_entries_are_prepared_again(
    session: Path, calls: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = read(session)
    flipped, truncated, lost = sorted((session / work.FOLDER).iterdir())
    data = bytearray(flipped.read_bytes())
    data[len(data) // 2] ^= 0x10
    flipped.write_bytes(data)
    truncated.write_bytes(truncated.read_bytes()[:100])
    lost.unlink()
    for _ in range(2):
        assert all(map(same, first, read(session)))
        assert calls["prepare_job"] == 6
    monkeypatch.setattr(work, "MAX_ENTRY_BYTES", 1000)
    key = flipped.name.removesuffix(".npz.gz")
    assert work.Store(session / work.FOLDER).get(key) is None, "more than may be unpacked"


def test_two_commands_at_once_do_no_harm(session: Path) -> None:
    with ThreadPoolExecutor(2) as both:
        one, other = both.map(read, (session, session))
    assert all(map(same, one, other))
    assert all(map(same, one, read(session)))
    assert len(list((session / work.FOLDER).iterdir())) == 3, "no half-written file is left"


def test_a_folder_that_cannot_be_written_does_not_stop_the_work(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "mkdir", no_space)
    assert len(read(session)) == 3
    assert not (session / work.FOLDER).exists()


def test_a_press_is_cut_out_of_its_page_before_the_page_is_resampled(session: Path, tmp_path: Path) -> None:
    page = imported_presses(tmp_path / "page", CONDITIONS[:1], (1500, 2000), (1380, 700))
    [whole], [near, *_] = read(page), read(session)
    assert whole.measured.area_mm2 == pytest.approx(near.measured.area_mm2, rel=0.01)
    assert np.abs(whole.coverage - near.coverage).mean() < 0.001
    [capture] = Recording(page).captures()
    raster, prepared = presses.rectified(capture, None)
    side = round(20.0 * (FIELD_MM + 32.0))
    assert raster.shape == pytest.approx((side, side), abs=40), "its field, and what its light is estimated from"
    assert prepared.anchor_px == pytest.approx([20.0 * (at + 16.0) for at in ANCHOR_MM], abs=20.0)


def test_what_cannot_be_read_has_no_scale_or_starts_outside_its_page_is_refused(session: Path) -> None:
    capture = next(Recording(session).captures())
    unscaled = replace(capture, stroke=Stroke(stroke_id="s", kind="press", still=0, anchor_mm=(3.0, 4.0)))
    [(name, why)] = presses.prepare_job((unscaled, None)).items()
    assert (name, str(why)) == ("refused", "has neither a calibration nor a scale of its own")
    torn = replace(capture, still_png=capture.still_png[:100]), None
    assert list(presses.prepare_job(torn)) == ["refused"]
    stroke = capture.stroke.model_copy(update={"anchor_px": (9000.0, 150.0)})
    with pytest.raises(CaptureRefused, match="no ink near its touch point"):
        presses.rectified(replace(capture, stroke=stroke), None)
