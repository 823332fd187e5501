"""Asks every configured device for its identity and state, and reports in one table what is wrong. Powers nothing.

`doctor --report` writes one archive for a bug report: the answers of the devices, and nothing that is secret.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import json
import math
import os
import platform
import re
import socket
import statistics
import time
import zipfile
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from rich.table import Table
from rich.text import Text

from brushloop.calibrate.board.pix2len import see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.rig.config import PREFIX, RigConfig
from brushloop.collect.rig.devices import identified, make_robot
from brushloop.drivers.arcs.controller import MOVING_ALLOWED, RobotMode
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.arcs.telemetry import RtdeStream
from brushloop.drivers.arcs.wire import Framing, RpcConnection, open_arcs
from brushloop.drivers.camera import OpenCvCamera
from brushloop.drivers.devices import Device, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, RpcError
from brushloop.drivers.force.sri_m8123 import ForceTable, SriM8123
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import InkTable

T = TypeVar("T")
CALLS = 20


@dataclass(slots=True)
class Finding:
    """What one device answered; filled in while it is asked."""

    device: str
    address: str
    answers: bool = False
    identity: str = ""
    firmware: str = ""
    latency_ms: float | None = None
    """Median of several calls; for a camera, the time to a frame exposed after the request."""
    notes: str = ""
    problem: str = ""
    remedy: str = ""

    @property
    def well(self) -> bool:
        """Whether nothing is wrong."""
        return self.answers and not self.problem

    async def timed(self, calls: int, ask: Callable[[], Awaitable[T]]) -> T:
        """The last answer of several calls, whose median time is the latency."""
        waits_ms: list[float] = []
        while True:
            began_s = time.perf_counter()
            answer = await ask()
            waits_ms.append((time.perf_counter() - began_s) * 1e3)
            if len(waits_ms) == calls:
                self.latency_ms = statistics.median(waits_ms)
                return answer


async def examine(config: RigConfig, clock: Clock) -> list[Finding]:
    """One finding for each configured device, in the order in which a session connects them."""
    findings = [await _camera(config, clock)]
    if config.force is not None:
        findings.append(await _force(config.force, clock))
    if config.ink.device is not None:
        findings.append(await _ink(config.ink.device, clock))
    return [*findings, await _robot(config, clock)]


async def _asked(finding: Finding, device: Device, look: Callable[[], Awaitable[None]]) -> Finding:
    """Connect a device, note who it is, and `look` at it; an error of the device is noted."""
    try:
        async with identified(device) as identity:
            await look()
        finding.answers, finding.identity, finding.firmware = True, identity.model, identity.firmware
        finding.notes += ", simulated" if identity.simulated else ""
    except DeviceError as error:
        finding.problem = f"{error.op}: {error.what}"
        finding.remedy = error.remedy or "Check power, cable and address."
    return finding


async def _camera(config: RigConfig, clock: Clock) -> Finding:
    finding, notices, lens = Finding("camera", config.camera.source), list[str](), config.camera.optics
    camera = OpenCvCamera(config.camera, clock, notices.append)

    async def look() -> None:
        await camera.fresh(Stamp(clock.now_ns()))
        frame = await finding.timed(5, lambda: camera.fresh(Stamp(clock.now_ns())))
        try:
            image = frame.image if lens is None else lens.undistort(frame.image)
            plane = (await asyncio.to_thread(see_board, image, config.board)).plane
        except CalibrationError as error:
            finding.problem = f"board: {error.what}"
            finding.remedy = "Put the configured board into view, in focus and evenly lit."
        else:
            board = f"board: {plane.corners} corners, residual {plane.rms_px:.2f} px, {plane.mm_per_px:.4f} mm/px"
            notices.insert(0, board)
        finding.notes = "; ".join(notices)

    return await _asked(finding, camera, look)


async def _force(config: ForceTable, clock: Clock) -> Finding:
    gateway = "" if config.host is None else f" at {config.host}:{config.port}"
    finding = Finding("force", f"{config.interface} {config.channel}{gateway}")
    sensor = SriM8123(config, clock)

    async def look() -> None:
        first = sensor.latest().stamp
        await asyncio.sleep(0.5)  # a hundred rounds give the rate
        newest = sensor.latest()
        rate_hz = 1e9 * (newest.stamp.seq - first.seq) / max(newest.stamp.host_ns - first.host_ns, 1)
        finding.latency_ms = (clock.now_ns() - newest.stamp.host_ns) / 1e6
        force_n, lost = math.hypot(*newest.force_n), sensor.assembler
        finding.notes = f"{rate_hz:.0f} readings/s, {force_n:.3f} N at rest, not zeroed yet"
        if lost.torn or lost.refused or sensor.bus_errors:
            finding.problem = f"{lost.torn} broken and {lost.refused} refused readings, {sensor.bus_errors} bus errors"
            finding.remedy = "Check wiring, shielding and termination."
        elif force_n > config.max_n:
            ceiling = f"above the ceiling force.max_n = {config.max_n:g} N"
            finding.problem = f"{force_n:.2f} N while nothing presses, {ceiling}"
            finding.remedy = "Remove what touches the brush. The holder's weight is subtracted at each start."

    return await _asked(finding, sensor, look)


async def _ink(config: InkTable, clock: Clock) -> Finding:
    finding, device = Finding("ink", config.port), config.device(clock)

    async def look() -> None:
        level = await finding.timed(CALLS, device.level)
        finding.notes = f"well {level:.0%} full" if level is not None else "no gauge"
        finding.latency_ms = finding.latency_ms if level is not None else None  # nothing was asked

    return await _asked(finding, device, look)


async def _robot(config: RigConfig, clock: Clock) -> Finding:
    finding, notices = Finding("robot", f"{config.robot.host}:{config.robot.port}"), list[str]()
    robot = make_robot(config, clock, notices.append)

    async def look() -> None:
        await finding.timed(CALLS, robot.where)
        mode, safety = await robot.modes()
        finding.notes = "; ".join([*notices, f"{mode}, safety {safety}"])
        if safety not in MOVING_ALLOWED:
            finding.problem = f"safety mode is {safety}"
            finding.remedy = "End this mode at the pendant; brushloop never does that."
        elif mode not in (RobotMode.POWER_OFF, RobotMode.IDLE, RobotMode.RUNNING):
            finding.problem, finding.remedy = f"robot mode is {mode}", "Look at the pendant."

    return await _asked(finding, robot, look)


def doctor_table(findings: list[Finding]) -> Table:
    """One row per device, with the verdict as a word as well as a colour."""
    table = Table("device", "verdict", "who answers", "latency", "notes, what is wrong, what to do", show_lines=True)
    for finding in findings:
        verdict = Text("ok", "green") if finding.well else Text("trouble" if finding.answers else "no answer", "red")
        who = " ".join(part for part in (finding.identity or finding.address, finding.firmware) if part)
        latency = "" if finding.latency_ms is None else f"{finding.latency_ms:.1f} ms"
        words = [finding.notes, finding.problem and f"{finding.problem}.", finding.remedy]
        table.add_row(finding.device, verdict, who, latency, "\n".join(w for w in words if w))
    return table


ABOUT = """\
Made by `brushloop doctor --report`. Read it before you send it: it is meant to hold no secret.
report.json  versions, platform, what each device answered, the numbers of rig.toml
arcs.jsonl   every question that was put to the arm's controller, and its answer
rtde.json    what the controller's telemetry offers, if it is configured
Taken out: names of hosts and users, addresses, paths, URLs, values of environment variables, every text of rig.toml.
There are no photographs in it.
"""
SHORTEST = 3
"""A shorter name would be found within ordinary words."""
PATTERNS = (
    (re.compile(r"\b[a-z][a-z0-9+.-]*://\S+", re.IGNORECASE), "<url>"),
    (re.compile(r"\S+@[\w-]+(\.[\w-]+)+"), "<e-mail>"),
    (re.compile(r"\b(?:[0-9a-f]{2}[:-]){5}[0-9a-f]{2}\b", re.IGNORECASE), "<address>"),
    (re.compile(r"\b\d{1,3}(?:\.\d{1,3}){3}\b"), "<address>"),
    (re.compile(r"(?<![\w.])(?:[0-9a-f]{0,4}:){3,7}[0-9a-f]{0,4}(?![\w.])", re.IGNORECASE), "<address>"),
    (re.compile(r"(?<![\w<>/])(?:~|/)[\w.~+-]*/[^\s'\",;]+"), "<path>"),
    (re.compile(r"\b[A-Za-z]:\\[^\s'\",;]+"), "<path>"),
)
KEPT = frozenset({"kind", "interface", "framing", "dictionary", "method"})
"""Fields of `rig.toml` whose text is one of a few fixed words; all other text in it is left out."""
NAMING = {"host": "<host>", "address": "<host>", "bus": "<host>", "source": "<camera>", "port": "<port>"}
"""Fields whose text identifies a device of the lab, wherever it occurs, and the placeholder for each."""


class Scrubber:
    """Replaces what identifies a person or a network: reports are sent to people outside the lab."""

    def __init__(self, rig: Mapping[str, Any]) -> None:
        """`rig` are the tables of `rig.toml`, whose names of devices are replaced."""
        names = {value: "<environment>" for name, value in os.environ.items() if name.upper().startswith(PREFIX)}

        def noted(field: str, text: str) -> str:
            if field in NAMING:
                names[text] = NAMING[field]
            return text

        _with_texts(rig, noted)
        names |= {
            socket.gethostname(): "<host>",
            socket.getfqdn(): "<host>",
            os.environ.get("LOGNAME", ""): "<user>",
            Path.home().name: "<user>",
            str(Path.home()): "<path>",
            str(Path.cwd()): "<path>",
        }
        self._names = sorted(((k, v) for k, v in names.items() if len(k) >= SHORTEST), key=lambda pair: -len(pair[0]))

    def text(self, text: str) -> str:
        """The text with all of these replaced."""
        for name, stands_for in self._names:
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", stands_for, text)
        for pattern, stands_for in PATTERNS:
            text = pattern.sub(stands_for, text)
        return text

    def value(self, value: Any) -> Any:
        """The same for every text in a JSON value."""
        return _with_texts(value, lambda _, text: self.text(text))


def _with_texts(value: Any, changed: Callable[[str, str], str], field: str = "") -> Any:
    """A JSON value with each text changed; `changed` gets the name of its field and the text."""
    match value:
        case str():
            return changed(field, value)
        case dict():
            table = cast("dict[str, Any]", value)
            return {name: _with_texts(inner, changed, name.rpartition(".")[2]) for name, inner in table.items()}
        case list() | tuple():
            return [_with_texts(inner, changed, field) for inner in cast("list[Any]", value)]
        case _:
            return value


# ---------------------------------------------------------------- a transcript of questions that change nothing

OF_THE_CONTROLLER = (
    "SystemInfo.getControlSoftwareVersionCode",
    "SystemInfo.getControlSoftwareFullVersion",
    "RuntimeMachine.getRuntimeState",
)
OF_THE_ROBOT = (
    *("RobotConfig.getRobotType", "RobotConfig.getRobotSubType", "RobotConfig.getControlBoxType", "RobotConfig.getDof"),
    *("RobotConfig.getTcpOffset", "RobotConfig.getPayload", "RobotConfig.getCollisionLevel"),
    *("RobotManage.getOperationalMode", "RobotManage.isSimulationEnabled", "MotionControl.getSpeedFraction"),
    *("MotionControl.getExecId", "MotionControl.getQueueSize", "RobotState.getRobotModeType"),
    *("RobotState.getSafetyModeType", "RobotState.isPowerOn", "RobotState.isSteady", "RobotState.getJointState"),
    *("RobotState.getTcpPose", "RobotState.getJointPositions"),
)
"""Asked without parameters; then kinematics are asked where the arm is, and for the newest messages."""
MESSAGES = 5
NO_ANSWER: dict[type[DeviceError], str] = {DeviceTimeout: "silence", ConnectionLost: "lost"}
"""What a transcript says instead of an answer; `refused` for any other error."""


async def survey(host: str, port: int, framing: Framing) -> list[dict[str, Any]]:
    """Ask everything on one connection, in the driver's order: version, then all about the first robot.

    Each exchange has `method`, `params`, `took_ms` and `answer`: `result` or `error` as the controller sent it, else
    `silence`, `lost` or `refused`, which says why there is none; then the next question is asked. Ends early where the
    controller does not connect or hangs up. Sets, powers and moves nothing.
    """
    connection = RpcConnection(host, port, framing=framing)
    exchanges: list[dict[str, Any]] = []

    async def ask(method: str, params: dict[str, Any] | None = None, step: Awaitable[Any] | None = None) -> Any:
        """The result of `method`, or of `step`; None without one."""
        if connection.lost:
            return None
        began_s, answer = time.monotonic(), dict[str, Any]()
        try:
            answer["result"] = await (step or connection.call(method, params))
        except RpcError as error:
            answer["error"] = {"code": error.code, "message": error.message}
        except DeviceError as error:
            answer[NO_ANSWER.get(type(error), "refused")] = error.what
        took_ms = round((time.monotonic() - began_s) * 1e3, 3)
        exchanges.append({"method": method, "params": params, "answer": answer, "took_ms": took_ms})
        return answer.get("result")

    try:
        await ask("connect", step=open_arcs(connection))
        if "result" in exchanges[0]["answer"]:
            exchanges.clear()  # the login has no answer to keep
        else:
            with suppress(DeviceError):  # a cabinet that does not answer the login may answer the rest
                await connection.open(login=False)
        await ask("SystemInfo.getInterfaceVersionCode")
        names = await ask("getRobotNames")
        robot = str(cast("list[Any]", names)[0]) if isinstance(names, list) and names else "rob1"
        methods = (*OF_THE_CONTROLLER, *(f"{robot}.{name}" for name in OF_THE_ROBOT))
        *_, pose, joints = [await ask(method) for method in methods]
        if joints and pose:
            await ask(f"{robot}.RobotAlgorithm.forwardKinematics", {"q": joints})
            await ask(f"{robot}.RobotAlgorithm.inverseKinematics", {"qnear": joints, "pose": pose})
        await ask(f"{robot}.Trace.peek", {"num": MESSAGES, "last_time": 0})
    finally:
        await connection.close()
    return exchanges


async def rtde_answers(host: str, port: int) -> dict[str, Any]:
    """What RTDE offers by name, and the newest sample of pose and joints; `refused` says why something is missing."""
    stream = RtdeStream(host, port)
    answers: dict[str, Any] = {}
    try:
        await stream.open()
        answers["sample"] = (await stream.samples())[-1]
    except DeviceError as error:
        answers["refused"] = str(error)
    finally:
        await stream.close()
    return {"offered": stream.offered, **answers}


async def write_report(
    path: Path, rig: Mapping[str, Any], robot: ArcsTable, findings: list[Finding], **known: Any
) -> None:
    """Record a transcript of the controller and write the archive. Raises OSError if it cannot be written.

    `rig` are the tables of `rig.toml`, of which only numbers are kept; `known` goes into `report.json` as it is.
    """
    scrubber = Scrubber(rig)
    report = {
        "format": 1,
        "versions": _versions(),
        "platform": {"system": platform.platform(), "python": platform.python_version(), "cores": os.cpu_count()},
        "framing": robot.framing,
        "findings": scrubber.value([{**asdict(finding), "well": finding.well} for finding in findings]),
        "rig": _with_texts(rig, lambda field, text: text if field in KEPT else "<text>"),
        **known,
    }
    lines = [json.dumps(scrubber.value(line)) + "\n" for line in await survey(robot.host, robot.port, robot.framing)]
    texts = {"README.txt": ABOUT, "report.json": json.dumps(report, indent=2), "arcs.jsonl": "".join(lines)}
    if robot.rtde_port is not None:
        answers = await rtde_answers(robot.host, robot.rtde_port)
        texts["rtde.json"] = json.dumps(scrubber.value(answers), indent=2)
    with path.open("xb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(name, text)


def _versions() -> dict[str, str]:
    """Versions of brushloop and of the libraries that it names."""
    named = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in importlib.metadata.requires("brushloop") or ()]
    installed = {package.name: package.version for package in importlib.metadata.distributions()}
    return {name: installed[name] for name in ("brushloop", *named) if name in installed}
