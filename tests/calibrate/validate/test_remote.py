"""Sessions from URLs: accepted by their checksum only. `memory:` stands for whatever fsspec opens, a server for S3."""

from __future__ import annotations

import hashlib
import importlib
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

import fsspec
import pytest

from brushloop.calibrate import session as sessions
from brushloop.calibrate.artefact import current
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.session import local_path
from brushloop.calibrate.validate.command import open_session
from tests.calibrate.given import CALIBRATION


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where copies of recordings are kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def url(session: Path) -> str:
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.pipe("/lab/presses/presses.mcap", (session / "presses.mcap").read_bytes())
    return "memory://lab/presses"


def digest(session: Path) -> str:
    return hashlib.sha256((session / "presses.mcap").read_bytes()).hexdigest()


@pytest.mark.parametrize("end", ["", "/presses.mcap"])
def test_a_url_with_its_checksum_opens_like_a_folder_and_is_fetched_once(session: Path, url: str, end: str) -> None:
    for _ in range(2):
        assert len(open_session(f"{url}{end}#sha256={digest(session)}").strokes) == 11
        fsspec.filesystem("memory").pipe("/lab/presses/presses.mcap", b"changed since")


def test_of_several_calibrations_beside_the_pointed_one_is_used(session: Path, url: str, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe("/lab/presses/presses.mcap.sha256", f"{digest(session)}  presses.mcap\n".encode())
    for rms_px in (0.1, 0.2):
        path = CALIBRATION.model_copy(update={"rms_px": rms_px}).save(tmp_path / "made")
        memory.pipe(f"/lab/presses/calibration/{path.name}", path.read_bytes())
    assert current(local_path(url).parent) is None, "without a pointer none comes along"
    for path in sorted((tmp_path / "made").iterdir()):
        memory.pipe("/lab/presses/calibration/current", f"{path.name}\n".encode())
        copy = current(local_path(url).parent)
        assert copy is not None
        assert copy.name == path.name
    memory.pipe("/lab/presses/calibration/current", b"../../../etc/passwd")
    with pytest.raises(CalibrationError, match="holds no name of an artefact"):
        open_session(url)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("memory://lab/presses", "has no checksum"),
        ("memory://lab/presses#sha256=" + "0" * 64, "0000 was expected"),
        ("memory://lab/nothing#sha256=" + "0" * 64, "cannot be read"),
        *(
            (f"{scheme}://lab/presses#sha256={'0' * 64}", "allowed: file://, memory://, http://")
            for scheme in ("nosuch", "zip", "github", "simplecache")
        ),
    ],
)
@pytest.mark.usefixtures("url")
def test_what_cannot_be_believed_is_refused_and_leaves_nothing(place: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=words):
        open_session(place)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(("kind", "package"), [("s3", "s3fs"), ("gs", "gcsfs")])
def test_a_url_whose_package_is_not_there_names_the_extra(
    kind: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(importlib.import_module("fsspec.registry")._registry, kind, raising=False)  # found before
    with pytest.raises(CalibrationError, match=rf"{kind}://lab/x: .*brushloop\[{kind}\]"):
        local_path(f"{kind}://lab/x#sha256=" + "0" * 64)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """A web server that neither lists folders nor serves ranges."""
    pytest.importorskip("aiohttp", reason="needs the extra [remote]")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

        def list_directory(self, path: object) -> Any:
            self.send_error(404)

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder.parent))) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/{folder.name}"
        server.shutdown()
        thread.join()


def test_a_web_server_is_a_place_like_any_other(tmp_path: Path) -> None:
    data = os.urandom(1024) * 8 * 1024  # fsspec asks for blocks of 5 MiB, and one read more
    folder = tmp_path / "long"
    folder.mkdir()
    (folder / "long.mcap").write_bytes(data)
    with served(folder) as web:
        with pytest.raises(CalibrationError, match="has no checksum"):
            local_path(web)
        (folder / "long.mcap.sha256").write_text(" " * 3000 + hashlib.sha256(data).hexdigest())
        assert local_path(f"{web}/long.mcap").read_bytes() == data


def test_a_web_server_that_stalls_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """It accepts the connection and never answers."""
    pytest.importorskip("aiohttp", reason="needs the extra [remote]")
    monkeypatch.setattr(sessions, "STALL_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(CalibrationError, match="cannot be read"):
        local_path(f"http://127.0.0.1:{silent.getsockname()[1]}/x.mcap#sha256={'0' * 64}")


@pytest.fixture
def bucket(session: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """`s3://lab/presses` on 127.0.0.1, with the environment that a user of S3 has and nothing of this machine's own."""
    if not all(map(find_spec, ("s3fs", "moto", "boto3"))):
        pytest.skip("needs the extra [s3], and moto")
    import boto3
    import s3fs
    from moto.server import ThreadedMotoServer

    running = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    named = {"ENDPOINT_URL": f"http://{host}:{port}", "ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": "secret"}
    named |= {"DEFAULT_REGION": "us-east-1", "EC2_METADATA_DISABLED": "true"}
    for name, value in (named | dict.fromkeys(("CONFIG_FILE", "SHARED_CREDENTIALS_FILE"), "/none")).items():
        monkeypatch.setenv(f"AWS_{name}", value)
    client = boto3.client("s3")
    client.create_bucket(Bucket="lab")
    client.put_object(Bucket="lab", Key="presses/presses.mcap", Body=(session / "presses.mcap").read_bytes())
    client.put_object(Bucket="lab", Key="presses/presses.mcap.sha256", Body=digest(session).encode())
    yield client
    client.close()
    s3fs.S3FileSystem.clear_instance_cache()
    running.stop()


def test_a_session_in_a_bucket_opens_like_one_at_home(bucket: Any, session: Path) -> None:
    assert open_session("s3://lab/presses").sha256 == digest(session)
    bucket.put_object(Bucket="lab", Key="presses/presses.mcap.sha256", Body=b"0" * 64)
    for place, said in (
        ("s3://lab/presses", f"has SHA-256 .*, {'0' * 64} was expected"),
        ("s3://no-such-bucket/presses", "has no checksum"),
        ("s3://no-such-bucket/presses#sha256=" + "0" * 64, "cannot be read: .*bucket does not exist"),
    ):
        with pytest.raises(CalibrationError, match=said):
            open_session(place)
