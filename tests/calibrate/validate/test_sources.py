"""Sessions from URLs: believed by their checksum only. `memory:` stands for whatever fsspec opens."""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import fsspec
import pytest

from brushloop.calibrate.artefact import current, put_to_use
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate import inputs
from brushloop.calibrate.validate.inputs import fetched, open_session
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import Closed, Open
from brushloop.sessions.journal import Journal
from brushloop.sessions.recording import Recording
from tests.calibrate.given import CALIBRATION


@pytest.fixture
def remote(session: Path) -> str:
    data = (session / "presses.mcap").read_bytes()
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.pipe("/lab/presses/presses.mcap", data)
    return "memory://lab/presses"


def digest(session: Path) -> str:
    return hashlib.sha256((session / "presses.mcap").read_bytes()).hexdigest()


def made(rms_px: float) -> Calibration:
    return CALIBRATION.model_copy(update={"rms_px": rms_px})


def test_a_url_with_its_checksum_opens_like_a_folder(session: Path, remote: str, tmp_path: Path) -> None:
    for url in (f"{remote}#sha256={digest(session)}", f"{remote}/presses.mcap#sha256={digest(session)}"):
        opened = open_session(url, tmp_path, None, None)
        assert opened.sha256 == digest(session)
        assert len(opened.strokes) == 11
        assert opened.kind == "press"


def test_the_checksum_may_lie_beside(session: Path, remote: str, tmp_path: Path) -> None:
    text = f"{digest(session)}  presses.mcap\n"
    fsspec.filesystem("memory").pipe("/lab/presses/presses.mcap.sha256", text.encode())
    assert open_session(remote, tmp_path, None, None).sha256 == digest(session)


def test_it_is_fetched_once(session: Path, remote: str, tmp_path: Path) -> None:
    url = f"{remote}#sha256={digest(session)}"
    open_session(url, tmp_path, None, None)
    fsspec.filesystem("memory").store["/lab/presses/presses.mcap"].seek(0)
    fsspec.filesystem("memory").pipe("/lab/presses/presses.mcap", b"changed since")
    assert len(open_session(url, tmp_path, None, None).strokes) == 11


def test_of_several_calibrations_beside_the_pointed_one_is_used(session: Path, remote: str, tmp_path: Path) -> None:
    """Neither the last by name, nor the one written last."""
    memory, url = fsspec.filesystem("memory"), f"{remote}#sha256={digest(session)}"
    first, *_, last = names = sorted(made(rms).save(tmp_path / "made").name for rms in (0.1, 0.2, 0.3))
    for name in (last, *names[:-1]):
        memory.pipe(f"/lab/presses/calibration/{name}", (tmp_path / "made" / name).read_bytes())
    beside = open_session(url, tmp_path, None, None).recording.path.parent
    assert current(beside) is None, "without a pointer none comes along"
    memory.pipe("/lab/presses/calibration/current", f"{first}\n".encode())
    assert current(open_session(url, tmp_path, None, None).recording.path.parent) == beside / "calibration" / first
    memory.pipe("/lab/presses/calibration/current", f"{last}\n".encode())
    assert current(open_session(url, tmp_path, None, None).recording.path.parent) == beside / "calibration" / last
    memory.pipe("/lab/presses/calibration/current", b"../../../etc/passwd")
    with pytest.raises(CalibrationError, match="holds no name of an artefact"):
        open_session(url, tmp_path, None, None)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("memory://lab/presses", "has no checksum"),
        ("memory://lab/presses#sha256=" + "0" * 64, "0000 was expected"),
        ("memory://lab/nothing#sha256=" + "0" * 64, "cannot be read"),
        *(
            (f"{scheme}://lab/presses#sha256={'0' * 64}", "allowed: file://, memory://, http://")
            for scheme in ("nosuch", "zip", "ftp", "github", "reference", "simplecache")
        ),
    ],
)
def test_what_cannot_be_believed_is_refused_and_leaves_nothing(
    remote: str, tmp_path: Path, url: str, words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        open_session(url, tmp_path, None, None)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(("kind", "package"), [("s3", "s3fs"), ("gs", "gcsfs")])
def test_a_url_whose_package_is_not_there_names_the_extra(
    kind: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(importlib.import_module("fsspec.registry")._registry, kind, raising=False)  # found before
    with pytest.raises(CalibrationError, match=rf"{kind}://lab/x: cannot be opened: .*brushloop\[{kind}\]"):
        open_session(f"{kind}://lab/x#sha256=" + "0" * 64, tmp_path, None, None)


def test_a_recording_larger_than_allowed_is_refused(
    session: Path, remote: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inputs, "MAX_DOWNLOAD_BYTES", 1000)
    with pytest.raises(CalibrationError, match="larger than 1000 bytes"):
        open_session(f"{remote}#sha256={digest(session)}", tmp_path, None, None)


@contextmanager
def served(session: Path, *, lists: bool = True) -> Iterator[str]:
    pytest.importorskip("aiohttp", reason="needs the extra [remote]")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

        def list_directory(self, path: object) -> Any:
            return super().list_directory(path) if lists else self.send_error(404)  # type: ignore[arg-type]

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(session.parent))) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/{session.name}"
        server.shutdown()
        thread.join()


@pytest.fixture
def web(session: Path) -> Iterator[str]:
    with served(session) as url:
        yield url


def test_a_web_server_that_lists_nothing_gives_the_calibration_in_use(session: Path, tmp_path: Path) -> None:
    folder = tmp_path / "presses"
    folder.mkdir()
    shutil.copy(session / "presses.mcap", folder)
    used = put_to_use(made(0.1), folder)
    made(0.2).save(used.parent)
    with served(folder, lists=False) as url:
        opened = open_session(f"{url}/presses.mcap#sha256={digest(session)}", tmp_path / "work", None, None)
    found = current(opened.recording.path.parent)
    assert found is not None
    assert found.name == used.name


def test_a_web_server_is_a_place_like_any_other(web: str, session: Path, tmp_path: Path) -> None:
    assert len(open_session(f"{web}/presses.mcap#sha256={digest(session)}", tmp_path, None, None).strokes) == 11
    with pytest.raises(CalibrationError, match="has no checksum"):
        open_session(f"{web}/presses.mcap", tmp_path, None, None)
    with pytest.raises(CalibrationError, match="cannot be read"):
        open_session(f"{web}/nothing.mcap#sha256={digest(session)}", tmp_path, None, None)


def test_a_web_server_that_stalls_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It accepts the connection and never answers."""
    pytest.importorskip("aiohttp", reason="needs the extra [remote]")
    monkeypatch.setattr(inputs, "STALL_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/x.mcap#sha256={'0' * 64}"
        with pytest.raises(CalibrationError, match="cannot be read"):
            open_session(url, tmp_path, None, None)


def test_a_recording_longer_than_a_block_comes_from_a_server_that_serves_no_ranges(
    web: str, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = os.urandom(1024) * 8 * 1024  # fsspec asks for blocks of 5 MiB, and one read more
    (session.parent / "long.mcap").write_bytes(data)
    (session.parent / "long.mcap.sha256").write_text(" " * 3000 + hashlib.sha256(data).hexdigest())
    url = f"{web.rpartition('/')[0]}/long.mcap"
    assert fetched(url, tmp_path).read_bytes() == data
    monkeypatch.setattr(inputs, "MAX_DOWNLOAD_BYTES", 10**6)
    with pytest.raises(CalibrationError, match=r"long.mcap: is larger than 1000000 bytes"):
        fetched(url, tmp_path / "again")
    assert not [path for path in (tmp_path / "again").rglob("*") if path.is_file()]


def test_a_recording_that_is_not_the_one_its_journal_closed_is_damaged(session: Path, tmp_path: Path) -> None:
    folder = tmp_path / "presses"
    folder.mkdir()
    (folder / "presses.mcap").write_bytes((session / "presses.mcap").read_bytes())
    header = Recording(session).header.model_copy(update={"session_id": "presses"})
    closed = Closed(t_ns=1, file="presses.mcap", sha256="0" * 64, counts={})
    journal = Journal(folder / "journal.jsonl", "presses")
    for event in (Open(t_ns=1, header=header), closed):
        journal.append(event)
    journal.close()
    with pytest.raises(SessionDamaged, match="SHA-256 differs"):
        open_session(str(folder), tmp_path / "work", None, None)
