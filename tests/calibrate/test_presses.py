"""Each press is found in its photograph once, and kept in the session's folder for every command."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brushloop.calibrate import presses, store
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.presses import Press, cut, too_thin, uncommanded
from brushloop.calibrate.session import open_session
from brushloop.sessions.recording import Recording, mark_bad_or_good
from tests.photographed import imported_presses

CELLS = [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    return imported_presses(tmp_path / "photos", tmp_path / "presses", CELLS, (300, 480), (380, 150))


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the presses that were prepared, in the order in which they were."""
    names: list[str] = []
    prepare = presses.prepare_job

    def counting(job: presses.PrepareJob) -> store.Arrays:
        names.append(job.capture.stroke.stroke_id)
        return prepare(job)

    monkeypatch.setattr(presses, "prepare_job", counting)
    return names


def read(session: Path, view: Field | None = None, refused: list[tuple[str, str]] | None = None) -> list[Press]:
    refused = [] if refused is None else refused
    return list(presses.read_presses(open_session(session), view or Field(), refused, uncommanded, cut, too_thin))


def same(one: Press, other: Press) -> bool:
    images = all(np.array_equal(one.images[key], other.images[key]) for key in one.images)
    return images and np.array_equal(one.coverage, other.coverage) and one.measured == other.measured


def test_a_press_is_prepared_once_for_each_scale(session: Path, prepared: list[str]) -> None:
    first = read(session)
    assert [press.stroke.depth_mm for press in first] == [11.0, 15.0, 20.0]
    again = read(session)
    assert len(prepared) == 3
    assert all(map(same, first, again))
    read(session, Field(mm_per_px=0.4))
    assert len(prepared) == 6


def test_damaged_large_and_lost_entries_are_prepared_again(
    session: Path, prepared: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = read(session)
    flipped, truncated, lost = sorted((session / store.FOLDER).iterdir())
    data = bytearray(flipped.read_bytes())
    data[len(data) // 2] ^= 0x10
    flipped.write_bytes(data)
    truncated.write_bytes(truncated.read_bytes()[:100])
    lost.unlink()
    assert all(map(same, first, read(session)))
    assert len(prepared) == 6
    assert all(map(same, first, read(session)))
    assert len(prepared) == 6
    monkeypatch.setattr(store, "MAX_ENTRY_BYTES", 1000)
    key = flipped.name.removesuffix(".npz.gz")
    assert store.Store(session / store.FOLDER).get(key) is None, "more than may be unpacked"


def test_the_oldest_entries_make_room(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read(session)
    monkeypatch.setattr(store, "MAX_BYTES", 1)
    open_session(session)
    assert list((session / store.FOLDER).iterdir()) == []


def test_a_folder_that_cannot_be_written_does_not_stop_the_work(
    session: Path, prepared: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "mkdir", full)
    assert len(read(session)) == 3
    assert not (session / store.FOLDER).exists()


def test_a_press_that_is_marked_bad_is_refused_and_comes_back_without_work(session: Path, prepared: list[str]) -> None:
    [name, *_] = [press.stroke.stroke_id for press in read(session)]
    mark_bad_or_good(session, 0, name, 1)
    refused: list[tuple[str, str]] = []
    assert len(read(session, refused=refused)) == 2
    assert refused == [(name, "was marked bad")]
    mark_bad_or_good(session, 0, name, 2)
    assert len(read(session)) == 3
    assert len(prepared) == 3


def test_a_press_is_cut_out_of_its_page_before_the_page_is_resampled(session: Path, tmp_path: Path) -> None:
    (tmp_path / "pages").mkdir()
    page = imported_presses(tmp_path / "pages", tmp_path / "page", CELLS[:1], (1500, 2000), (1380, 700))
    [whole], [near, *_] = read(page), read(session)
    assert whole.measured.area_mm2 == pytest.approx(near.measured.area_mm2, rel=0.01)
    assert np.abs(whole.coverage - near.coverage).mean() < 0.001
    [capture] = Recording(page).captures()
    raster, _, prepared = presses.crop(capture, None)
    side = round(20.0 * (Field().side_mm + 32.0))
    assert raster.shape == pytest.approx((side, side), abs=40), "its field, and what its light is estimated from"
    assert prepared.anchor_px == pytest.approx([20.0 * (at + 16.0) for at in Field().anchor_mm], abs=20.0)


def test_a_start_outside_its_page_is_refused(tmp_path: Path) -> None:
    (tmp_path / "pages").mkdir()
    page = imported_presses(tmp_path / "pages", tmp_path / "page", CELLS[:1], (300, 480), (380, 150))
    [capture] = Recording(page).captures()
    stroke = capture.stroke.model_copy(update={"anchor_px": (9000.0, 150.0)})
    with pytest.raises(CaptureRefused, match="none of it is in the field"):
        presses.crop(replace(capture, stroke=stroke), None)
