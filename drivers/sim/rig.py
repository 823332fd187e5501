"""The loopback rig: one world, the devices around it on 127.0.0.1, its `rig.toml`, and its process."""

import asyncio
import contextlib
import functools
import json
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from brushloop.drivers.force.simulator import ForceBoard, SocketcandServer
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL
from brushloop.drivers.host import alongside
from brushloop.drivers.ink.simulator import PUMP_ML, InstrumentServer, PumpFirmware, StationFirmware
from brushloop.drivers.loopback import LoopbackServer, RigRefused
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, fault_of
from brushloop.drivers.sim.scene import MjpegServer, Scene
from brushloop.drivers.sim.world import World, push_on

TEMPLATE = Path(__file__).with_name("rig.toml.j2")
"""Of the `rig.toml`, as an operator would have taught it."""
LOOPBACK_HEAD = "# The loopback rig"
PORTS = {"arcs": 30004, "rtde": 30010, "camera": 8080, "force": 29536}
"""Of a real rig, by what is served there."""
HOST = "127.0.0.1"
"""Not configurable: no other machine may drive or watch a simulated arm by mistake."""


def rig_toml(
    config: SimConfig, host: str = HOST, ink_path: str = "/dev/ttyUSB0", ports: Mapping[str, int] = PORTS
) -> str:
    """TOML text for devices at these addresses."""
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
        ports=PORTS | {**ports},
        pump_ml=PUMP_ML,
        bus=LOOPBACK_CHANNEL,
    )


class LoopbackRig:
    """`async with LoopbackRig(config) as rig:` serves until the block ends."""

    def __init__(self, config: SimConfig, host: str = HOST, ports: Mapping[str, int] | None = None) -> None:
        """`host` is another loopback address, where one lab is to have the ports of a real one for itself.

        The system chooses a port that is not in `ports`.
        """
        self.config = config
        self.host = host
        self.world = World(config)
        self.arcs = ArcsServer(self.world)
        self.rtde = RtdeServer(self.arcs)
        self.faults = self.arcs.faults
        """One board for all servers."""
        self.scene = Scene(self.world)
        """What the camera looks at."""
        self.camera = MjpegServer(self.world, lambda tool: self.scene.render(tool), self.faults)
        self.servers: dict[str, LoopbackServer] = {"arcs": self.arcs, "rtde": self.rtde, "camera": self.camera}
        self.force: SocketcandServer | None = None
        if config.force_sensor:
            noise_n, noise_nm = config.force_noise_n, config.force_noise_nm
            board = ForceBoard(self.world.wrench, noise_n=noise_n, noise_nm=noise_nm, seed=config.seed)
            board.next_fault = functools.partial(self.faults.kind_met, Device.FORCE)
            self.force = self.servers["force"] = SocketcandServer(board, rate_hz=config.force_hz)
        self.ink: InstrumentServer | None = None
        if config.ink_device != "none":
            firmware = PumpFirmware if config.ink_device == "pump" else StationFirmware
            self.ink = self.servers["ink"] = InstrumentServer(firmware(self.world.well))
            self.ink.next_fault = functools.partial(self.faults.kind_met, Device.INK)
        self._ports = ports or {}
        self._open = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with contextlib.AsyncExitStack() as opening:
            opening.push_async_callback(self._stop)
            for name in self.servers:
                await self.start(name)
            if self.force is not None:
                await asyncio.to_thread(push_on, self.config.brush)  # it is slow to find
            watching = alongside(self.faults.watch(self.arcs.cabinet.safety_stop), "faults")
            await opening.enter_async_context(watching)
            self._open = opening.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._open.aclose()

    async def start(self, name: str) -> None:
        """Serve one of the servers."""
        await self.servers[name].start(self.host, self._ports.get(name, 0))

    async def _stop(self) -> None:
        for server in self.servers.values():
            await server.stop()

    @property
    def ink_path(self) -> str:
        """Where pyserial opens the line of the ink device; empty without one."""
        return "" if self.ink is None else f"socket://{self.host}:{self.ink.port}"

    def toml(self) -> str:
        """A `rig.toml` for this rig, as an operator would have taught it."""
        ports = {name: server.port for name, server in self.servers.items()}
        return rig_toml(self.config, self.host, self.ink_path, ports)

    def labels(self, control: Path | None = None) -> list[str]:
        """What a person can read at the rig, whose control socket may be at `control`."""
        return [*self.toml().splitlines(), "# Ctrl-C ends"]

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

    async def hand(self, act: str = "", to: str = "", index: int = 0, corner: str = "") -> str:
        """Ask the person in the lab for something; return what was done. Raises ValueError for what cannot be."""
        raise ValueError("there is no person here: only the lab of `brushloop sim --unknown` has one")

    async def idle(self, seconds: float) -> None:
        """Return once no client has been connected for `seconds`."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while loop.time() - since < seconds:
            if any(server.clients for server in self.servers.values()):
                since = loop.time()
            await asyncio.sleep(0.2)


USAGE = (
    'not a request: {"do": "add", "fault": {...}}, or "list", "clear" (with a number "id" or without), '
    '"state", "release", "fresh-sheet", "hand"'
)


class ControlServer(LoopbackServer):
    """Live control of one rig, described in docs/loopback-controller.md: `async with ControlServer(rig, path):`.

    The socket at `path` is its owner's alone; one of a rig that has ended is replaced. Raises `RigRefused`.
    """

    def __init__(self, rig: LoopbackRig, path: Path) -> None:
        super().__init__()
        self._rig = rig
        self._path = path

    async def __aenter__(self) -> Self:
        path = self._path
        with contextlib.suppress(OSError):  # nobody listens
            _, writer = await asyncio.open_unix_connection(path)
            writer.close()
            raise RigRefused(f"{path}: another rig listens here")
        # Set before the path exists: another user could connect before a later `chmod`.
        mask = os.umask(0o177)
        try:
            self._server = await asyncio.start_unix_server(self._serve, path)
        except OSError as error:
            raise RigRefused(f"{path}: cannot listen here: {error.strerror or error}") from None
        finally:
            os.umask(mask)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()
        self._path.unlink(missing_ok=True)

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

    async def _obey(self, request: Any) -> dict[str, Any]:
        rig, faults = self._rig, self._rig.faults
        match request:
            case {"do": "add", "fault": fault, **others} if not others:
                return {"id": faults.hang(fault_of(fault))}
            case {"do": "list", **others} if not others:
                return {"hanging": [hung.as_json() for hung in faults.hanging]}
            case {"do": "clear", "id": int() as ident, **others} if not others:
                return {"taken": int(faults.take(ident))}
            case {"do": "clear", **others} if not others:
                return {"taken": faults.clear()}
            case {"do": "state", **others} if not others:
                return rig.state()
            case {"do": "release", **others} if not others:
                return {"was": rig.arcs.cabinet.release()}
            case {"do": "fresh-sheet", **others} if not others:
                rig.world.fresh_sheet()
                return {}
            case {"do": "hand", **wanted} if wanted.keys() <= {"act", "to", "index", "corner"}:
                return {"says": await rig.hand(**wanted)}
            case _:
                raise ValueError(USAGE)


async def serve(
    rig: LoopbackRig,
    tell: Callable[..., None],
    *,
    write_rig: Path | None = None,
    idle_exit_s: float = 0.0,
    control: Path | None = None,
) -> None:
    """Serve until Ctrl-C, SIGTERM, or no client for `idle_exit_s`, where 0 means never; SIGUSR1 changes the sheet.

    Print what a person reads at the rig, or write its `rig.toml`. Raises `RigRefused` for a control socket or a
    `rig.toml` that cannot be written, and rather than overwrite a file that no loopback rig wrote.
    """
    if write_rig and not write_rig.parent.is_dir():
        raise RigRefused(f"{write_rig}: there is no folder {write_rig.parent}")
    if write_rig and write_rig.exists() and not write_rig.read_bytes().startswith(LOOPBACK_HEAD.encode()):
        raise RigRefused(f"{write_rig}: exists and was not written by a loopback rig; it is not overwritten")
    over, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
    async with rig, contextlib.nullcontext() if control is None else ControlServer(rig, control):
        if write_rig is None:
            tell(*rig.labels(control))
        else:
            part = write_rig.with_name(write_rig.name + ".part")  # a reader sees all of the file or nothing
            try:
                part.write_text(rig.toml(), encoding="utf-8")
                part.replace(write_rig)
            except OSError as error:
                raise RigRefused(f"{write_rig}: cannot be written: {error.strerror}") from None
            tell(f"{write_rig} is written: brushloop doctor --config {write_rig}; Ctrl-C ends")
        if idle_exit_s > 0:
            idle = asyncio.create_task(rig.idle(idle_exit_s))
            idle.add_done_callback(lambda _: over.set())
        await over.wait()
