"""The loopback rig as a whole: one world and the devices around it, on 127.0.0.1 and on pseudo terminals."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Literal

from drivers.sim.arcs.rtde_server import RtdeServer
from drivers.sim.arcs.server import ArcsServer
from drivers.sim.camera.mjpeg_server import MjpegServer
from drivers.sim.camera.scene import Scene
from drivers.sim.config import SimConfig
from drivers.sim.faults.control import live_control
from drivers.sim.faults.rig_faults import Faults
from drivers.sim.faults.script import hang_script, load_faults
from drivers.sim.instruments.force_board import ForceBoard
from drivers.sim.instruments.ink_station import Instrument, PtyLine, StationFirmware
from drivers.sim.instruments.modbus_pump import PumpFirmware
from drivers.sim.instruments.socketcand_server import SocketcandServer
from drivers.sim.rig_toml import LOOPBACK_HEAD, PUMP_ML, Addresses, rig_toml
from drivers.sim.world import World

HOST = "127.0.0.1"
"""Not configurable: nothing off this machine may ever drive or watch a simulated arm by mistake."""


class LoopbackRig:
    """`async with LoopbackRig(config) as rig:` serves until the block ends."""

    def __init__(self, config: SimConfig) -> None:
        self.config = config
        self.world = World(config)
        self.arcs = ArcsServer(self.world)
        self.rtde = RtdeServer(self.arcs.cabinet)
        view = config.view
        self.camera = MjpegServer(Scene(self.world), fps=view.fps, jpeg_quality=view.jpeg_quality, view=view)
        self.force = _force(self.world) if config.force_sensor else None
        self.ink = None if config.ink_device == "none" else PtyLine(_ink(self.world, config.ink_device))
        board = None if self.force is None else self.force.board
        self.faults = Faults(self.world, self.arcs, self.rtde, self.camera, ink=self.ink, force=board)

    async def __aenter__(self) -> LoopbackRig:
        try:
            await asyncio.to_thread(self.world.reaction.prepare)  # both the cabinet and the sensor tell the push
            await self.arcs.start(HOST, self.config.arcs_port)
            await self.rtde.start(HOST, self.config.rtde_port)
            await self.camera.start(HOST, self.config.camera_port)
            if self.force is not None:
                await self.force.start(HOST, self.config.force_port)
            if self.ink is not None:
                self.ink.__enter__()
            self.faults.start()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.faults.stop()
        if self.ink is not None:
            self.ink.close()
        if self.force is not None:
            await self.force.stop()
        await self.camera.stop()
        await self.rtde.stop()
        await self.arcs.stop()

    def toml(self) -> str:
        """A `rig.toml` for this rig, as an operator would have taught it."""
        force_port = None if self.force is None else self.force.port
        ink_path = None if self.ink is None else self.ink.path
        return rig_toml(
            self.config,
            Addresses(HOST, self.arcs.port, self.rtde.port, self.camera.port, force_port, ink_path),
        )

    def where(self) -> str:
        """One line for people: which device listens where."""
        places = [f"controller on {HOST}:{self.arcs.port} and {self.rtde.port}", f"camera on {self.camera.port}"]
        if self.force is not None:
            places.append(f"force on {self.force.port}")
        if self.ink is not None:
            places.append(f"ink on {self.ink.path}")
        return ", ".join(places)

    async def idle(self, seconds: float) -> None:
        """Return once no client has been connected for so long."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while loop.time() - since < seconds:
            if self.arcs.clients + self.rtde.clients + self.camera.clients + (self.force.clients if self.force else 0):
                since = loop.time()
            await asyncio.sleep(0.2)


def _force(world: World) -> SocketcandServer:
    config = world.config
    board = ForceBoard(
        lambda _t_s: world.wrench(), noise_n=config.force_noise_n, noise_nm=config.force_noise_nm, seed=config.seed
    )
    return SocketcandServer(board, world.clock, world.reaction, rate_hz=config.force_hz)


def _ink(world: World, device: Literal["station", "pump"]) -> Instrument:
    reservoir_ml = world.config.reservoir_ml
    if device == "station":
        return StationFirmware(reservoir_ml=reservoir_ml, well=world.well)
    return PumpFirmware(ml_per_revolution=PUMP_ML, reservoir_ml=reservoir_ml, on_pumped=world.well.add)


def serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None] = lambda _text: None,
    *,
    faults: Path | None = None,
    control: Path | None = None,
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never), with a script of faults if there is one.

    Raises `RigFileExists` rather than overwrite a file that no loopback rig wrote, `FaultScriptError`, and
    `ControlPathError` where no control socket can be made.
    """
    asyncio.run(_serve(config, write_rig, idle_exit_s, tell, faults, control))


async def _serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None],
    faults: Path | None,
    control: Path | None,
) -> None:
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    if write_rig is not None:
        _refuse_to_overwrite(write_rig)
    script = load_faults(faults) if faults is not None else ()
    async with LoopbackRig(config) as rig, live_control(rig.faults, control):
        if faults is not None:
            hang_script(faults, rig.faults.hang, script)
        loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
        if write_rig is not None:
            _write_whole(write_rig, rig.toml())
        tell(f"{rig.where()}; Ctrl-C ends")
        waits: list[asyncio.Task[object]] = [asyncio.create_task(over.wait())]
        if idle_exit_s > 0:
            waits.append(asyncio.create_task(rig.idle(idle_exit_s)))
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for wait in waits:
            wait.cancel()
        await asyncio.gather(*waits, return_exceptions=True)


class RigFileExists(Exception):
    """The file cannot be written: there is no such folder, or it is not a loopback rig's and may be a lab's own."""

    exit_code: ClassVar[int] = 2


def _refuse_to_overwrite(path: Path) -> None:
    if not path.parent.is_dir():
        raise RigFileExists(f"{path}: there is no folder {path.parent}")
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(LOOPBACK_HEAD.encode())):
        raise RigFileExists(f"{path}: exists and was not written by a loopback rig; it is not overwritten")


def _write_whole(path: Path, text: str) -> None:
    """Whoever waits for the file sees all of it or none."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
