"""A session in an S3 bucket: a server that speaks its protocol, on 127.0.0.1, with a calibrated session in it."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app, main
from brushloop.calibrate.session import calibrate_session
from brushloop.calibrate.validate.report import load_report
from brushloop.sessions.records import Stroke
from tests.calibrate.simulated_rigs import sheet

if TYPE_CHECKING:
    from conftest import Photographed

NEEDED = ("s3fs", "moto", "boto3")
# Looked for and not imported: every worker collects this file, and one of them runs it.
pytestmark = pytest.mark.skipif(not all(map(find_spec, NEEDED)), reason="needs the extra [s3], and moto")

PRESSED = ((11.0, 0.0), (13.0, 5.0))


@pytest.fixture(scope="module")
def calibrated(photographed: Photographed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two presses under a camera without distortion, and the calibration."""
    shot = sheet(0, len(PRESSED))
    strokes = [
        Stroke(
            stroke_id=f"s{k}",
            kind="press",
            still=0,
            depth_mm=depth_mm,
            tilt_deg=tilt_deg,
            anchor_mm=anchor,
            cell_mm=(anchor[0] - 30.0, anchor[1] - 12.0, 40.0, 24.0),
        )
        for k, ((depth_mm, tilt_deg), anchor) in enumerate(zip(PRESSED, shot.anchors_mm, strict=True))
    ]
    folder = tmp_path_factory.mktemp("lab") / "grid-01"
    photographed(folder, shot.board, [shot.image], [(stroke, shot.image) for stroke in strokes])
    calibrate_session(folder)
    return folder


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    running = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


@pytest.fixture
def account(endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """The environment that a user of S3 has, and nothing of this machine's own; a process as new as a user's."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    yield
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def bucket(account: None, endpoint: str, calibrated: Path) -> Iterator[Any]:
    """`s3://lab/grid-01`: the recording, its checksum beside, its calibration."""
    import boto3

    client = boto3.client("s3")
    client.create_bucket(Bucket="lab")
    data = (calibrated / "grid-01.mcap").read_bytes()
    client.put_object(Bucket="lab", Key="grid-01/grid-01.mcap", Body=data)
    checksum = f"{hashlib.sha256(data).hexdigest()}  grid-01.mcap\n"
    client.put_object(Bucket="lab", Key="grid-01/grid-01.mcap.sha256", Body=checksum.encode())
    for path in (calibrated / "calibration").iterdir():
        client.put_object(Bucket="lab", Key=f"grid-01/calibration/{path.name}", Body=path.read_bytes())
    yield client
    client.close()


def refusal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What the front door says, in one line, before it ends with exit code 2."""
    monkeypatch.setattr(sys, "argv", ["brushloop", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    [line] = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.usefixtures("bucket")
def test_a_session_in_a_bucket_is_validated_like_one_at_home(calibrated: Path, tmp_path: Path) -> None:
    words = ("--model", "line", "--no-held-out", "--no-parquet", "--out")
    for place, out in (("s3://lab/grid-01", "away"), (str(calibrated), "home")):
        ran = CliRunner().invoke(app, ["validate", place, *words, str(tmp_path / out)])
        assert ran.exit_code == 0, (ran.output, ran.exception)
    away, home = (load_report(tmp_path / name / "report.json") for name in ("away", "home"))
    assert away.stats == home.stats
    # How it was collected is in the journal, which stays at home.
    assert home.sessions[0].collected is not None
    assert away.sessions == tuple(s.model_copy(update={"collected": None}) for s in home.sessions)
    assert away.sessions[0].calibration
    assert away.label == "loopback rig"


def test_a_wrong_checksum_or_a_missing_bucket_is_one_line_and_leaves_nothing(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    bucket.put_object(Bucket="lab", Key="grid-01/grid-01.mcap.sha256", Body=b"0" * 64)
    for place, words in (
        ("s3://lab/grid-01", f"has SHA-256 .*, {'0' * 64} was expected"),
        ("s3://no-such-bucket/grid-01", "has no checksum"),
        ("s3://no-such-bucket/grid-01#sha256=" + "0" * 64, "cannot be read: .*bucket does not exist"),
        ("s3://lab/none#sha256=" + "0" * 64, "cannot be read: "),
    ):
        said = refusal(monkeypatch, capsys, "validate", place, "--out", str(out))
        assert said.startswith(f"brushloop: {place.partition('#')[0]}: ")
        assert re.search(words, said), said
        assert not out.exists()


@pytest.mark.usefixtures("bucket")
def test_without_credentials_it_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    said = refusal(monkeypatch, capsys, "validate", "s3://lab/grid-01", "--out", str(tmp_path / "out"))
    assert "credentials" in said.lower(), said
    assert not (tmp_path / "out").exists()
