"""The loopback rig: one world, the devices around it on 127.0.0.1 and on ptys, its `rig.toml`, and its process."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import math
import os
import signal
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, cast

from brushloop.drivers.force.simulator import ForceBoard, SocketcandServer
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL, Wrench
from brushloop.drivers.geometry import inverse, of_angles, product, turned
from brushloop.drivers.ink.simulator import PtyLine, PumpFirmware, StationFirmware
from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.brush.spec import SimFileError
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, FaultBoard, fault_of
from brushloop.drivers.sim.scene import MjpegServer, Scene
from brushloop.drivers.sim.world import World

TEMPLATE = Path(__file__).with_name("rig.toml.j2")
"""Of the `rig.toml`, as an operator would have taught it."""
LOOPBACK_HEAD = "# The loopback rig"
PUMP_ML = 0.1
"""Delivery of the loopback pump, ml per revolution."""


HOST = "127.0.0.1"
"""Not configurable: no other machine may drive or watch a simulated arm by mistake."""


def rig_toml(config: SimConfig, host: str = HOST, ink_path: str = "/dev/ttyUSB0") -> str:
    """TOML text for devices at these addresses; a port that the configuration leaves to the system is a real one's."""
    from jinja2 import Environment, StrictUndefined  # slow to import

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        head=LOOPBACK_HEAD,
        config=config,
        table=config.table,
        host=host,
        ink_path=ink_path,
        pump_ml=PUMP_ML,
        bus=LOOPBACK_CHANNEL,
    )


class LoopbackRig:
    """`async with LoopbackRig(config) as rig:` serves until the block ends."""

    def __init__(self, config: SimConfig, host: str = HOST) -> None:
        """`host` is another loopback address, where one lab is to have the ports of a real one for itself."""
        self.config = config
        self._host = host
        self.world = World(config)
        self.force = None
        if config.force_sensor:
            noise_n, noise_nm = config.force_noise_n, config.force_noise_nm
            board = ForceBoard(self._wrench, noise_n=noise_n, noise_nm=noise_nm, seed=config.seed)
            self.force = SocketcandServer(board, self.world.clock.now_s, rate_hz=config.force_hz)
        self.ink: PtyLine | None = None
        if config.ink_device == "station":
            self.ink = PtyLine(StationFirmware(self.world.well))
        elif config.ink_device == "pump":
            self.ink = PtyLine(PumpFirmware(self.world.well, ml_per_revolution=PUMP_ML))
        missing = {Device.INK: self.ink, Device.FORCE: self.force}
        self.faults = FaultBoard(self.world, [device for device, server in missing.items() if server is None])
        """One board for all servers."""
        self.arcs = ArcsServer(self.world, self.faults)
        self.rtde = RtdeServer(self.arcs.cabinet, self.faults)
        self.scene = Scene(self.world)
        """What the camera looks at."""
        self.camera = MjpegServer(self.world, self.scene.render, config.view, self.faults)
        self.servers: dict[LoopbackServer, int] = {
            self.arcs: config.arcs_port,
            self.rtde: config.rtde_port,
            self.camera: config.camera_port,
        }
        """What is served, and the port of each; 0 lets the system choose."""
        if self.ink is not None:
            self.ink.next_fault = functools.partial(self.faults.kind_met, Device.INK)
        if self.force is not None:
            self.force.board.next_fault = functools.partial(self.faults.kind_met, Device.FORCE)
            self.servers[self.force] = config.force_port
        self._open = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with contextlib.AsyncExitStack() as opening:
            opening.push_async_callback(self._stop)
            for server, port in self.servers.items():
                await server.start(self._host, port)
            if self.force is not None:
                await asyncio.to_thread(self.world.reaction.push_n, 1.0, 0.0)  # the first is slow
            if self.ink is not None:
                opening.enter_context(self.ink)
            watching = asyncio.create_task(self.faults.watch(self.arcs.cabinet.safety_stop), name="faults")
            opening.callback(watching.cancel)
            self._open = opening.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._open.aclose()

    def _wrench(self, _t_s: float) -> Wrench:
        """The wrench as the sensor reports it, whose axes and sign depend on how it is mounted."""
        config, wrench = self.world.config, self.world.wrench()
        about_x, about_y = (math.radians(v) for v in config.tool_lean_deg)
        sensor = of_angles(0.0, 0.0, math.radians(config.sensor_turn_deg))
        brush_in_sensor = product(inverse(sensor), of_angles(about_x, about_y, 0.0))
        force_n, torque_nm = (turned(brush_in_sensor, part) for part in (wrench[:3], wrench[3:]))
        fx, fy, fz, mx, my, mz = (config.sensor_sign * value for value in (*force_n, *torque_nm))
        return fx, fy, fz, mx, my, mz

    async def _stop(self) -> None:
        for server in self.servers:
            await server.stop()

    def toml(self) -> str:
        """A `rig.toml` for this rig, as an operator would have taught it."""
        arcs, rtde, camera = self.arcs.port, self.rtde.port, self.camera.port
        served = replace(self.config, arcs_port=arcs, rtde_port=rtde, camera_port=camera)
        if self.force is not None:
            served = replace(served, force_port=self.force.port)
        return rig_toml(served, self._host, "" if self.ink is None else self.ink.path)

    def state(self) -> dict[str, Any]:
        """Current state of the world, as JSON."""
        power, world = self.arcs.cabinet.power, self.world
        return {
            "now_s": round(world.clock.now_s(), 3),
            "phase": self.faults.phase().value,
            "moving": world.target() is not None,
            "tip_mm": [round(v, 3) for v in world.tool().position_mm],
            "presses": len(world.presses),
            "ink_load": round(world.ink_load, 3),
            "robot_mode": power.mode.value,
            "safety_mode": power.safety.value,
            "faults": len(self.faults.hanging),
        }

    def reconfigure(self, config: SimConfig) -> None:
        """Change table, view or sensor while serving, as a person in the lab would; tool and brush stay."""
        self.config = self.world.config = config
        self.scene = Scene(self.world)
        self.camera.show(self.scene.render, config.view)

    async def hand(self, request: Mapping[str, object]) -> dict[str, Any]:
        """Ask the person in the lab for something. Raises ValueError, with one line, for what nobody can do."""
        raise ValueError("there is no person here: only the lab of `brushloop sim --unknown` has one")

    async def idle(self, seconds: float) -> None:
        """Return once no client has been connected for `seconds`."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while loop.time() - since < seconds:
            if any(server.clients for server in self.servers):
                since = loop.time()
            await asyncio.sleep(0.2)


USAGE = (
    'not a request: {"do": "add", "fault": {...}}, or "list", "clear" (with a number "id" or without), '
    '"state", "release", "fresh-sheet", "hand"'
)


class ControlServer(LoopbackServer):
    """Live control of one rig: the requests are in docs/faults.md."""

    def __init__(self, rig: LoopbackRig) -> None:
        super().__init__()
        self._rig = rig

    async def listen(self, path: Path) -> None:
        """Listen at `path` for its owner alone; a socket of a rig that has ended is replaced. Raises `SimFileError`."""
        if path.exists() and not path.is_socket():
            raise SimFileError(path, "", "exists and is not a socket; it is not overwritten")
        with contextlib.suppress(OSError):  # nobody listens
            _, writer = await asyncio.open_unix_connection(path)
            writer.close()
            raise SimFileError(path, "", "another rig listens here")
        # Set before the path exists: another user could connect before a later `chmod`.
        mask = os.umask(0o177)
        try:
            self._server = await asyncio.start_unix_server(self._serve, path)
        except OSError as error:
            raise SimFileError(path, "", f"cannot listen here: {error.strerror or error}") from None
        finally:
            os.umask(mask)

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer line by line."""
        while True:
            line = await reader.readuntil(b"\n")
            try:
                answer = {"ok": True, **await self._obey(json.loads(line))}
            except (ValueError, RecursionError) as error:
                text = "not JSON" if isinstance(error, json.JSONDecodeError | RecursionError) else str(error)
                answer = {"ok": False, "error": text.replace("\n", " ")[:500]}
            writer.write(json.dumps(answer, separators=(",", ":")).encode() + b"\n")
            await writer.drain()

    async def _obey(self, said: object) -> dict[str, Any]:
        request = cast("dict[str, Any]", said) if isinstance(said, dict) else {}
        board, alone = self._rig.faults, len(request) == 1
        match request:
            case {"do": "add", "fault": dict()} if len(request) == 2:
                return {"id": board.hang(fault_of(request["fault"]))}
            case {"do": "list"} if alone:
                return {"hanging": [hung.as_json() for hung in board.hanging]}
            case {"do": "clear"} if alone:
                return {"taken": board.clear()}
            case {"do": "clear", "id": int(ident)} if len(request) == 2 and not isinstance(ident, bool):
                return {"taken": int(board.take(ident))}
            case {"do": "state"} if alone:
                return self._rig.state()
            case {"do": "release"} if alone:
                return {"was": self._rig.arcs.cabinet.release()}
            case {"do": "fresh-sheet"} if alone:
                self._rig.world.fresh_sheet()
                return {}
            case {"do": "hand"} if set(request) <= {"do", "act", "to", "index", "corner"}:
                return await self._rig.hand(request)
            case _:
                raise ValueError(USAGE)


@contextlib.asynccontextmanager
async def live_control(rig: LoopbackRig, path: Path) -> AsyncGenerator[None]:
    """A control socket at `path` until the block ends. Raises `SimFileError`."""
    server = ControlServer(rig)
    await server.listen(path)
    try:
        yield
    finally:
        await server.stop()
        path.unlink(missing_ok=True)


def serve(
    config: SimConfig, write_rig: Path | None, idle_exit_s: float, tell: Callable[..., None], control: Path | None
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never); print the `rig.toml` or write it.

    Raises `SimFileError` for a control socket or a `rig.toml` that cannot be written, and rather than overwrite a file
    that no loopback rig wrote.
    """
    if write_rig and not write_rig.parent.is_dir():
        raise SimFileError(write_rig, "", f"there is no folder {write_rig.parent}")
    if write_rig and write_rig.exists() and not write_rig.read_bytes().startswith(LOOPBACK_HEAD.encode()):
        raise SimFileError(write_rig, "", "exists and was not written by a loopback rig; it is not overwritten")
    rig = LoopbackRig(config)

    def announce() -> None:
        if write_rig is None:
            tell(*rig.toml().splitlines(), "# Ctrl-C ends")
            return
        part = write_rig.with_name(write_rig.name + ".part")
        try:
            part.write_text(rig.toml(), encoding="utf-8")
            part.replace(write_rig)  # a reader sees all of it or none
        except OSError as error:
            raise SimFileError(write_rig, "", f"cannot be written: {error.strerror}") from None
        tell(f"{write_rig} is written: brushloop doctor --config {write_rig}; Ctrl-C ends")

    asyncio.run(serve_until_over(rig, control, idle_exit_s, announce))


async def serve_until_over(
    rig: LoopbackRig, control: Path | None, idle_exit_s: float, announce: Callable[[], None]
) -> None:
    """Serve until Ctrl-C, SIGTERM, or no client for `idle_exit_s`; SIGUSR1 changes the sheet."""
    over, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
    async with rig, contextlib.nullcontext() if control is None else live_control(rig, control):
        announce()
        if idle_exit_s > 0:
            idle = asyncio.create_task(rig.idle(idle_exit_s))
            idle.add_done_callback(lambda _: over.set())
        await over.wait()
