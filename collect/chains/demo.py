"""`brushloop demo`: the real commands, in order, against a loopback rig in a process of its own.

All files go under one folder. A demo that is killed and started again continues where it stopped: the rig's process,
which holds the simulated sheet, outlives the demo by a minute.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from pathlib import Path

from collect.chains.commands import GIVEN_UP, finished_session, run_command
from collect.errors import CollectAborted
from collect.rig.config import RigConfig, load_rig
from sessions.folders import open_sessions
from sessions.terminal import say

HEIGHTS_MM = [11.0, 13.0, 15.0, 17.0, 20.0]
TILTS_DEG = [0.0, 5.0, 10.0]
START_S = 60.0
IDLE_EXIT_S = 60.0


def run_demo(out: Path, repeats: int, rate: float, seed: int) -> int:
    """Collect, calibrate, fit and validate under `out`; at the end print the paths of the report and of the MCAP.

    Returns the exit code, 3 if the collection left strokes out. A session without a report is continued; a new one is
    started only when the last one has its report.
    """
    out.mkdir(parents=True, exist_ok=True)
    rig_toml, protocol_toml, sessions = out / "rig.toml", out / "protocol.toml", out / "sessions"
    protocol = (
        f'kind = "grid"\nheights_mm = {HEIGHTS_MM}\ntilts_deg = {TILTS_DEG}\nrepeats = {repeats}\nseed = {seed}\n'
    )
    if not protocol_toml.exists() or protocol_toml.read_text(encoding="utf-8") != protocol:
        protocol_toml.write_text(protocol, encoding="utf-8")
    if (session := finished_session(sessions, protocol_toml)) is not None and not _report(session).is_file():
        say(f"continuing with {session}: its collection is finished")
        _evaluate(session)
        return 0
    finished = sessions.is_dir() and any(sessions.iterdir()) and not open_sessions(sessions)
    rig = _serving(rig_toml, rate, seed, fresh=finished)
    try:
        sheet = ("--sheet", "1") if finished else ()
        files = ("--config", rig_toml, "--protocol", protocol_toml, "--out", sessions)
        code = run_command(say, "collect", *files, "--no-tui", *sheet, accepts=(0, GIVEN_UP))
    finally:
        if rig is not None and rig.poll() is not None:
            say(f"the loopback rig ended with {rig.returncode}; see {out / 'rig.log'}", err=True)
    session = max(sessions.iterdir(), key=lambda path: path.stat().st_mtime_ns)
    _evaluate(session)
    if rig is not None:
        rig.terminate()
        rig.wait()
    return code


def _evaluate(session: Path) -> None:
    for command in ("calibrate", "fit", "validate"):
        run_command(say, command, session)
    say("", f"Report: {_report(session)}", f"MCAP:   {session / f'{session.name}.mcap'}")


def _report(session: Path) -> Path:
    return session / "validation" / "report.html"


def _serving(rig_toml: Path, rate: float, seed: int, *, fresh: bool) -> subprocess.Popen[bytes] | None:
    """Start a rig; return None if the rig of an earlier demo still runs and has a session to finish."""
    arcs_port, camera_port = _free_port(), _free_port()
    if rig_toml.exists() and not fresh:
        known = load_rig(rig_toml)
        arcs_port, camera_port = known.robot.port, _camera_port(known)
        if _listens(arcs_port) and _listens(camera_port):
            return None
    log = (rig_toml.parent / "rig.log").open("ab")
    command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(rig_toml), "--rate", str(rate)]
    command += ["--seed", str(seed), "--arcs-port", str(arcs_port), "--camera-port", str(camera_port)]
    # In a process session of its own: Ctrl-C at the demo must not end the rig under the arm.
    with log:
        process = subprocess.Popen(
            [*command, "--idle-exit", str(IDLE_EXIT_S)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    deadline = time.monotonic() + START_S
    while not (_listens(arcs_port) and _listens(camera_port) and _names(rig_toml, arcs_port)):
        if process.poll() is not None or time.monotonic() > deadline:
            raise CollectAborted(f"the loopback rig did not start; see {rig_toml.parent / 'rig.log'}")
        time.sleep(0.1)
    return process


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _names(rig_toml: Path, arcs_port: int) -> bool:
    return rig_toml.exists() and f"port = {arcs_port}\n" in rig_toml.read_text(encoding="utf-8")


def _camera_port(rig: RigConfig) -> int:
    return int(rig.camera.source.split(":")[2].split("/")[0])
