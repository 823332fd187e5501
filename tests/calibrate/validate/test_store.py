"""Finished work survives a kill and a damaged record; what is lost is only done again."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from brushloop.calibrate.validate.store import Store

PUTTING = """
import sys
from pathlib import Path
from brushloop.calibrate.validate.store import Store
with Store(Path(sys.argv[1])) as store:
    for number in range(100_000):
        store.put(str(number), {"data": bytes(5000)})
        print(number, flush=True)
"""


def test_what_was_put_is_there_for_the_next_process(tmp_path: Path) -> None:
    with Store(tmp_path / "work.sqlite") as store:
        store.put("a", {"n": 1, "data": b"\x00" * 1000})
        store.put("b", {"n": 2})
        assert store.get("a")["data"] == b"\x00" * 1000
    with Store(tmp_path / "work.sqlite") as store:
        assert "a" in store
        assert store.get("b") == {"n": 2}
        assert len(store) == 2
        assert store.keys() == ["a", "b"]
        with pytest.raises(KeyError):
            store.get("c")


def test_a_killed_process_loses_nothing_that_it_had_put(tmp_path: Path) -> None:
    path = tmp_path / "work.sqlite"
    with subprocess.Popen([sys.executable, "-c", PUTTING, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = [process.stdout.readline() for _ in range(50)]
        process.send_signal(signal.SIGKILL)
        said += process.stdout.readlines()
    with Store(path) as store:
        whole = [line.strip() for line in said if line.endswith("\n")]
        found = store.keys()
        assert found[: len(whole)] == whole
        assert all(store.get(key) == {"data": bytes(5000)} for key in found)


@pytest.mark.parametrize("cut", [1, 5000, 9000])
def test_a_file_that_is_cut_off_is_begun_anew_or_read_whole(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "work.sqlite"
    with Store(path) as store:
        store.put("a", {"n": 1})
        store.put("b", {"data": b"x" * 20_000})
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - cut)
    with Store(path) as store:
        found = store.keys()
        assert all(store.get(key) for key in found)
        store.put("b", {"n": 3})
    with Store(path) as store:
        assert store.get("b") == {"n": 3}


def test_a_flipped_bit_drops_the_record(tmp_path: Path) -> None:
    path = tmp_path / "work.sqlite"
    with Store(path) as store:
        for name in "abc":
            store.put(name, {"data": name.encode() * 100})
    data = bytearray(path.read_bytes())
    data[data.index(b"b" * 50)] ^= 1
    path.write_bytes(data)
    with Store(path) as store:
        assert store.keys() == ["a", "c"]


def test_a_file_of_something_else_is_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "work.sqlite"
    path.write_bytes(b"something else" * 1000)
    with Store(path) as store:
        assert len(store) == 0


def test_a_place_that_cannot_be_written_is_an_os_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "work.sqlite").mkdir()
    with pytest.raises(OSError, match="unable to open") as caught:
        Store(tmp_path / "work.sqlite")
    assert caught.value.filename == str(tmp_path / "work.sqlite")
