"""Finished work survives a torn end and a damaged record; what is lost is only done again."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibrate.validate.store import Store


def test_what_was_put_is_there_for_the_next_process(tmp_path: Path) -> None:
    with Store(tmp_path / "work.bin") as store:
        store.put("a", {"n": 1, "data": b"\x00" * 1000})
        store.put("b", {"n": 2})
        assert store.get("a")["data"] == b"\x00" * 1000
    with Store(tmp_path / "work.bin") as store:
        assert "a" in store
        assert store.get("b") == {"n": 2}
        assert len(store) == 2
        with pytest.raises(KeyError):
            store.get("c")


@pytest.mark.parametrize("cut", [1, 5, 20, 1000])
def test_a_torn_end_is_cut_off_and_the_rest_stays(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "work.bin"
    with Store(path) as store:
        store.put("a", {"n": 1})
        whole = path.stat().st_size
        store.put("b", {"data": b"x" * 2000})
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - cut)
    with Store(path) as store:
        assert "a" in store
        assert "b" not in store
        assert path.stat().st_size == whole
        store.put("b", {"n": 3})
    with Store(path) as store:
        assert store.get("b") == {"n": 3}


def test_a_flipped_bit_drops_the_record_and_what_follows(tmp_path: Path) -> None:
    path = tmp_path / "work.bin"
    with Store(path) as store:
        for name in "abc":
            store.put(name, {"data": name.encode() * 100})
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with Store(path) as store:
        assert "a" in store
        assert "b" not in store
        assert "c" not in store


def test_a_file_of_something_else_is_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "work.bin"
    path.write_bytes(b"something else" * 100)
    with Store(path) as store:
        assert len(store) == 0
