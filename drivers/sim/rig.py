"""The loopback rig as a whole: one world, its controller and its camera, on 127.0.0.1 and nowhere else."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from drivers.sim.arcs_server import ArcsServer
from drivers.sim.config import SimConfig
from drivers.sim.mjpeg_server import MjpegServer
from drivers.sim.rig_toml import LOOPBACK_HEAD, rig_toml
from drivers.sim.rtde_server import RtdeServer
from drivers.sim.scene import Scene
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
        self.camera = MjpegServer(Scene(self.world), fps=config.view.fps, jpeg_quality=config.view.jpeg_quality)

    async def __aenter__(self) -> LoopbackRig:
        try:
            await self.arcs.start(HOST, self.config.arcs_port)
            await self.rtde.start(HOST, self.config.rtde_port)
            await self.camera.start(HOST, self.config.camera_port)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.camera.stop()
        await self.rtde.stop()
        await self.arcs.stop()

    def toml(self) -> str:
        """A `rig.toml` for this rig, as an operator would have taught it."""
        return rig_toml(self.config, HOST, self.arcs.port, self.camera.port)

    async def idle(self, seconds: float) -> None:
        """Return once no client has been connected for so long."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while loop.time() - since < seconds:
            if self.arcs.clients + self.rtde.clients + self.camera.clients:
                since = loop.time()
            await asyncio.sleep(0.2)


def serve(
    config: SimConfig, write_rig: Path | None, idle_exit_s: float, tell: Callable[[str], None] = lambda _text: None
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never).

    Raises `RigFileExists` rather than overwrite a file that no loopback rig wrote.
    """
    asyncio.run(_serve(config, write_rig, idle_exit_s, tell))


async def _serve(config: SimConfig, write_rig: Path | None, idle_exit_s: float, tell: Callable[[str], None]) -> None:
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    if write_rig is not None:
        _refuse_to_overwrite(write_rig)
    async with LoopbackRig(config) as rig:
        loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
        if write_rig is not None:
            _write_whole(write_rig, rig.toml())
        tell(f"controller on {HOST}:{rig.arcs.port}, camera on {HOST}:{rig.camera.port}; Ctrl-C ends")
        waits: list[asyncio.Task[object]] = [asyncio.create_task(over.wait())]
        if idle_exit_s > 0:
            waits.append(asyncio.create_task(rig.idle(idle_exit_s)))
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for wait in waits:
            wait.cancel()
        await asyncio.gather(*waits, return_exceptions=True)


class RigFileExists(Exception):
    """The file is there and is not a loopback rig's: it may be a lab's own."""

    exit_code: ClassVar[int] = 2


def _refuse_to_overwrite(path: Path) -> None:
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(LOOPBACK_HEAD.encode())):
        raise RigFileExists(f"{path}: exists and was not written by a loopback rig; it is not overwritten")


def _write_whole(path: Path, text: str) -> None:
    """Whoever waits for the file sees all of it or none."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
