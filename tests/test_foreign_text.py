"""What a file or a folder from elsewhere says is printed and never obeyed, whichever command prints it."""

from __future__ import annotations

import json
import shutil
import struct
import sys
import zlib
from pathlib import Path
from random import Random

import pytest

import brushloop.__main__
from brushloop.sessions.events import StepKind
from brushloop.sessions.terminal import plain
from tests.sessions.conftest import Make

HOSTILE = "\x1b]0;owned\x07\x1b]52;c;cm0gLXJm\x07\x1b[2J\x9b31m\u202eltr\r[bold][/x][link=http://a]"
NAME = HOSTILE.replace("/", "")
"""The same, as a file may be called."""
ACTED_ON = [*map(chr, [*range(9), *range(11, 32), *range(127, 160)]), "\u202e", "\u2028"]
HEADER = dict.fromkeys(("software", "brush", "lens", "ink", "paper", "robot", "robot_firmware", "licence"), HOSTILE)


def with_profile(png: bytes) -> bytes:
    """The PNG with a broken colour profile whose name acts on a terminal; libpng prints such a name to stderr."""
    profile = struct.pack(">I", 1000) + bytes(128) + Random(1).randbytes(868)
    body = b"iCCP" + b"a\x9b31m\x85\x1b[2J\0" + b"\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:33] + chunk + png[33:]


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a session that says such things wherever a text is free: one closed, one open, one damaged."""
    make, folder = Make(), tmp_path_factory.mktemp("foreign")
    for name in ("closed", "open", "damaged"):
        store = make.store(folder / name, **HEADER, session_id=name, protocol=HOSTILE)
        shown = [make.still(0), make.stroke(0, stroke_id=f"key{NAME}")]
        make.take(store, "key", shown, make.captured(f"key{NAME}", 0), 1)
        store.void(store.begin("cut", StepKind.PRESS, patches=(2,), press=make.press(HOSTILE)), HOSTILE)
        store.begin("begun", StepKind.PRESS, patches=(3,), press=make.press(HOSTILE)).writer.abandon()
        if name == "closed":
            store.close()
        store.release()
    for file in (folder / "damaged").glob("0000-*.mcap"):
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    shutil.copytree(folder / "open", folder / f"name{NAME}")
    (folder / "photos").mkdir()
    (folder / "photos" / "profile.png").write_bytes(with_profile(make.png()))
    (folder / "photos" / "table.csv").write_text("file,px_per_mm,start_x_px,start_y_px\nprofile.png,1,0,12\n")
    store = make.store(folder / "profile", session_id="profile")
    still = make.still(0, with_profile(make.png()))
    make.take(store, "a", [still, make.stroke(0, kind="drag", px_per_mm=(1.0, 1.0))], make.captured("a", 0))
    store.close()
    store.release()
    table = f'"file{HOSTILE.replace(chr(13), "")}",px_per_mm\na.png,1\n'
    (folder / "table.csv").write_text(table, encoding="utf-8")
    (folder / "rig.toml").write_text(f"[robot]\n{json.dumps(HOSTILE)} = {json.dumps(HOSTILE)}\n", encoding="utf-8")
    (folder / "fit.json").write_text(json.dumps({"kind": HOSTILE, HOSTILE: HOSTILE}), encoding="utf-8")
    return folder


COMMANDS = [
    "sessions list .",
    "sessions show closed",
    "sessions show open",
    "sessions show closed --json",
    "sessions show damaged",
    "sessions verify closed",
    "sessions verify open",
    "sessions verify damaged",
    "sessions repair open",
    "sessions repair damaged",
    "sessions export closed exported",
    "sessions import . --csv table.csv",
    "sessions import photos --csv photos/table.csv --out imported",
    "sessions verify profile",
    "sessions repair profile",
    "sessions export profile out --crops",
    "validate profile --no-held-out",
    "validate closed",
    "validate diff fit.json fit.json",
    "calibrate closed",
    "fit closed",
    "recover closed",
    "repress compare closed closed",
    "write compare closed --plan fit.json",
    "write plan fit.json",
    "doctor --config rig.toml",
    "collect plan --config rig.toml --protocol rig.toml",
    "collect --config rig.toml --protocol rig.toml --no-tui",
    "train --config rig.toml",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_lets_what_it_read_act_on_the_terminal(
    command: str, hostile: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "elsewhere"
    shutil.copytree(hostile, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["brushloop", *command.split()])
    with pytest.raises(SystemExit) as ended:
        brushloop.__main__.main()
    captured = capfd.readouterr()
    assert captured.out + captured.err
    assert not [char for char in ACTED_ON if char in captured.out + captured.err]
    assert ended.value.code != 1, captured.err
    assert "Traceback" not in captured.err


def test_a_line_end_in_a_name_does_not_make_a_line_of_its_own() -> None:
    assert plain("a\nsession is sound") == "a\\u000asession is sound"


def test_json_keeps_its_values_and_chinese_its_characters() -> None:
    header = {"brush": f"羊毫 \U000e0041{HOSTILE}"}
    printed = plain(json.dumps(header, ensure_ascii=False))
    assert json.loads(printed) == header
    assert "羊毫" in printed
