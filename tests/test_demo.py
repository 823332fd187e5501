"""The demo as a user runs it, with a kill -9 in the middle: everything is there exactly once."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader

from sessions.journal.journal import replay
from sessions.journal.lines import read_lines
from sessions.reader import Recording

DEMO = [sys.executable, "-m", "brushloop", "demo", "--repeats", "1", "--rate", "40"]


def captures_done(out: Path) -> int:
    journals = list(out.glob("sessions/*/journal.jsonl"))
    return journals[0].read_bytes().count(b'"event":"done","key"') if journals else 0


@pytest.mark.timeout(300)
def test_killed_in_mid_collection_the_same_command_ends_with_every_stroke_exactly_once(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [*DEMO, "--out", str(out)]
    for steps in (9, 30):
        first = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 120
        while captures_done(out) < steps:
            assert time.monotonic() < deadline
            assert first.poll() is None
            time.sleep(0.02)
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()

    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr

    [session] = (out / "sessions").iterdir()
    state = replay(session / "journal.jsonl")
    assert state.closed is not None
    begun = [line for line in read_lines(session / "journal.jsonl") if line["event"] == "begin"]
    cells = [(line["sheet"], line["cell"]) for line in begun if line["cell"] is not None]
    assert len(cells) == len(set(cells)), "no cell is ever pressed twice"

    strokes = [capture.stroke for capture in Recording(session).captures()]
    assert len(strokes) == 15
    assert len({(s.height_mm, s.tilt_deg) for s in strokes}) == 15

    counts: Counter[str] = Counter()
    with (session / f"{session.name}.mcap").open("rb") as file:
        for _schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            counts[channel.topic] += 1
            if channel.topic == "/camera/still":
                data = np.frombuffer(CompressedImage.FromString(message.data).data, np.uint8)
                assert cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).shape == (1536, 2048)
    assert counts == Counter(state.closed["counts"])
    journalled: Counter[str] = Counter()
    for line in state.segments:
        journalled.update(line["counts"])
    assert counts == journalled

    printed = re.search(r"Report: (\S+report\.html)\nMCAP:   (\S+\.mcap)", ran.stdout)
    assert printed is not None
    page = Path(printed[1]).read_text()
    assert '<span class="source">loopback rig</span>' in page
    assert "not a result on paper" in page
    assert Path(printed[2]).is_file()
