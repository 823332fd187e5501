"""The archive of arrays: whole for numpy and for Python's own reader, whatever its size, and columns without gaps."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from brushloop.sessions.export import npz, npz_file
from brushloop.sessions.export.export import export
from brushloop.sessions.export.npz import Numbers, Texts
from brushloop.sessions.export.npz_file import NpzFile, packed_image


def written(path: Path, members: int) -> Path:
    with path.open("xb") as file:
        archive = NpzFile(file)
        for number in range(members):
            archive.add(packed_image(f"image_{number:04d}", np.full((2, 3), number % 251, np.uint8)))
        column = Numbers("d", 3)
        column.extend(float(value) for value in range(30))
        archive.add_pieces("position_mm", column.pieces())
        archive.finish()
    return path


def test_numpy_reads_pictures_and_columns(tmp_path: Path) -> None:
    with np.load(written(tmp_path / "a.npz", 3), allow_pickle=False) as arrays:
        assert arrays.files == ["image_0000", "image_0001", "image_0002", "position_mm"]
        np.testing.assert_array_equal(arrays["image_0002"], np.full((2, 3), 2, np.uint8))
        np.testing.assert_array_equal(arrays["position_mm"], np.arange(30.0).reshape(10, 3))


def test_equal_arrays_make_equal_files(tmp_path: Path) -> None:
    assert written(tmp_path / "a.npz", 2).read_bytes() == written(tmp_path / "b.npz", 2).read_bytes()


def test_more_members_than_16_bits_count_are_listed(tmp_path: Path) -> None:
    with zipfile.ZipFile(written(tmp_path / "a.npz", 66_000)) as archive:
        assert len(archive.namelist()) == 66_001
        assert np.lib.format.read_array(archive.open("image_65999.npy")).max() == 65_999 % 251


def test_offsets_and_sizes_beyond_32_bits_have_longer_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz_file, "LIMIT", 100)  # as if 100 bytes were 4 GiB
    with zipfile.ZipFile(written(tmp_path / "a.npz", 20)) as archive:
        assert archive.testzip() is None
        assert archive.getinfo("position_mm.npy").file_size > 100


def test_columns_are_the_same_from_the_disk_as_from_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "VALUES_WAITING", 4)
    numbers, texts = Numbers("q"), Texts()
    for value in range(10):
        numbers.extend((value,))
        texts.append("墨" * value)
    with (tmp_path / "a.npz").open("xb") as file:
        archive = NpzFile(file)
        archive.add_pieces("n", numbers.pieces())
        archive.add_pieces("t", texts.pieces())
        archive.finish()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert arrays["n"].tolist() == list(range(10))
        assert arrays["n"].dtype == np.int64
        assert arrays["t"].tolist() == ["墨" * value for value in range(10)]


def test_a_value_that_only_a_later_stroke_has_is_nan_before(make, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    later = make.stroke(1, commanded={"length_mm": 30.0})
    path = make.record(tmp_path / "a.mcap", make.still(0), make.stroke(0), make.still(1), later)
    export(path, tmp_path / "out", "npz")
    with np.load(tmp_path / "out" / "strokes.npz", allow_pickle=False) as arrays:
        assert np.isnan(arrays["commanded_length_mm"][0])
        assert arrays["commanded_length_mm"][1] == 30.0
