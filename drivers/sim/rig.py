"""The loopback rig as a whole: one world, the devices around it on 127.0.0.1 and on ptys, faults, and `rig.toml`."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from dataclasses import dataclass
from typing import Any

from brushloop.drivers.force.simulator import ForceBoard, SocketcandServer
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL, Wrench
from brushloop.drivers.geometry import inverse, of_angles, product, turned
from brushloop.drivers.ink.simulator import PtyLine, PumpFirmware, StationFirmware
from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, FaultBoard
from brushloop.drivers.sim.scene import MjpegServer, Scene
from brushloop.drivers.sim.world import World

LOOPBACK_HEAD = "# The loopback rig"
TAUGHT_TOUCH_ERROR_MM = 0.03
"""Error of a taught touch height."""
SEEN_S = 0.05
"""Real time within which a pose is seen by polling."""
PUMP_RESERVOIR_ML = 100.0
PUMP_ML = 0.1
"""Delivery of the loopback pump, ml per revolution."""


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where the devices of one rig are served."""

    host: str
    arcs_port: int
    rtde_port: int
    camera_port: int
    force_port: int | None
    ink_path: str | None


def rig_toml(config: SimConfig, at: Addresses) -> str:
    """TOML text; addresses as served."""
    table, view, brush = config.table, config.view, config.brush
    touch_z_mm = table.paper_z_mm + TAUGHT_TOUCH_ERROR_MM
    device = {
        "station": f'kind = "ink-station"\nport = "{at.ink_path}"\nlight = 0.8\n',
        "pump": f'kind = "modbus-pump"\nport = "{at.ink_path}"\nml_per_revolution = {PUMP_ML}\n',
    }
    ink_device = f"\n[ink.device]\n{device[config.ink_device]}" if config.ink_device in device else ""
    fast = f"simulated time runs at {config.rate:g} times real time"
    # A whole dwell could pass between two polls, and the age of a sample says little about the arm.
    least_dwell = f"least_dwell_s = {SEEN_S * config.rate:g}    # {fast}\n" if config.rate > 2.0 else ""
    stale = "100.0" if config.rate <= 1.0 else f"1000.0    # allowed on this bus alone: {fast}"
    force = f"""
[force]
kind = "sri-m8123"
interface = "socketcand"
channel = "{LOOPBACK_CHANNEL}"
host = "{at.host}"
port = {at.force_port}
stale_ms = {stale}
"""
    head = config.head
    quality = "" if head is None else f"\n[quality]\nhead_mm = {head.head_mm}\nmisplaced_mm = {head.misplaced_mm}\n"
    return f"""\
{LOOPBACK_HEAD}, seed {config.seed}. Simulated: nothing measured on it is a result on paper.
name = "loopback rig"

[robot]
kind = "aubo-arcs"
host = "{at.host}"
port = {at.arcs_port}
rtde_port = {at.rtde_port}
tcp_offset_mm = [0.0, 0.0, 180.0]

[robot.limits]
x_mm = [200.0, 640.0]
y_mm = [-260.0, 260.0]
z_mm = [95.0, 400.0]
tilt_deg = 15.0
speed_mm_s = 250.0
acc_mm_s2 = 1000.0

[camera]
kind = "opencv"
source = "http://{at.host}:{at.camera_port}/stream.mjpg"
latency_ms = 250.0
max_delay_ms = 3000.0     # drawn and encoded on the same machine as the run, a picture may be late
max_jitter_ms = 2000.0
lens = "simulated, {view.px_per_mm:g} px/mm, no distortion"

[brush]
name = "{config.brush_name or f"simulated bristle bundle, seed {brush.seed}"}"
radius_mm = {brush.radius_mm}
length_mm = {brush.length_mm}
max_depth_mm = 22.0

[paper]
name = "simulated Xuan paper"
origin_mm = [{table.origin_mm[0]}, {table.origin_mm[1]}]
yaw_deg = {table.yaw_deg}
touch_z_mm = {touch_z_mm:.3f}
size_mm = [{table.sheet_mm[0]}, {table.sheet_mm[1]}]
cell_mm = [40.0, 24.0]
touch_point_mm = [2.0, 2.0]

[ink]
name = "simulated ink"
well_mm = [{table.well_mm[0]}, {table.well_mm[1]}]
dip_z_mm = {table.paper_z_mm + table.ink_level_mm - 8.0}
{ink_device}{"" if at.force_port is None else force}
[board]
squares = [{table.board_squares[0]}, {table.board_squares[1]}]
square_mm = {table.board_square_mm}
marker_mm = {table.board_marker_mm}
dictionary = "{table.board_dictionary}"
origin_mm = [{table.board_origin_mm[0]}, {table.board_origin_mm[1]}]

[motion]
safe_z_mm = {table.paper_z_mm + 60.0}
park_mm = [{config.home_mm[0]}, {config.home_mm[1]}, {config.home_mm[2]}]
travel_speed_mm_s = 200.0
press_speed_mm_s = 20.0
acc_mm_s2 = 800.0
{least_dwell}{quality}"""


HOST = "127.0.0.1"
"""Not configurable: no other machine may drive or watch a simulated arm by mistake."""


class LoopbackRig:
    """`async with LoopbackRig(config) as rig:` serves until the block ends."""

    def __init__(self, config: SimConfig, host: str = HOST) -> None:
        """`host` is another loopback address, where one lab is to have the ports of a real one for itself."""
        self.config = config
        self._host = host
        self.world = World(config)
        self.force = _force(self.world) if config.force_sensor else None
        self.ink = _ink(self.world)
        missing = {Device.INK: self.ink, Device.FORCE: self.force}
        self.faults = FaultBoard(self.world, [device for device, server in missing.items() if server is None])
        """One board for all servers."""
        self.arcs = ArcsServer(self.world, self.faults)
        self.rtde = RtdeServer(self.arcs.cabinet, self.faults)
        self.scene = Scene(self.world)
        """What the camera looks at."""
        self.camera = MjpegServer(self.scene, config.view, self.faults)
        if self.ink is not None:
            self.ink.next_fault = functools.partial(self.faults.kind_met, Device.INK)
        if self.force is not None:
            self.force.board.next_fault = functools.partial(self.faults.kind_met, Device.FORCE)
        self._open = contextlib.AsyncExitStack()

    async def __aenter__(self) -> LoopbackRig:
        async with contextlib.AsyncExitStack() as opening:
            for server, port in self._servers():
                opening.push_async_callback(server.stop)
                await server.start(self._host, port)
            if self.force is not None:
                await asyncio.to_thread(self.world.reaction.prepare)  # takes some tenths of a second
            if self.ink is not None:
                opening.enter_context(self.ink)
            watching = asyncio.create_task(self.faults.watch(self.arcs.cabinet.safety_stop), name="faults")
            opening.callback(watching.cancel)
            self._open = opening.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._open.aclose()

    def _servers(self) -> list[tuple[LoopbackServer, int]]:
        """The servers on a port, and the port of each; 0 lets the system choose."""
        config = self.config
        force = [] if self.force is None else [(self.force, config.force_port)]
        return [
            (self.arcs, config.arcs_port),
            (self.rtde, config.rtde_port),
            (self.camera, config.camera_port),
            *force,
        ]

    def toml(self) -> str:
        """A `rig.toml` for this rig, as an operator would have taught it."""
        force_port = None if self.force is None else self.force.port
        ink_path = None if self.ink is None else self.ink.path
        return rig_toml(
            self.config,
            Addresses(self._host, self.arcs.port, self.rtde.port, self.camera.port, force_port, ink_path),
        )

    def where(self) -> str:
        """One line for people: which device listens where."""
        places = [f"controller on {self._host}:{self.arcs.port} and {self.rtde.port}", f"camera on {self.camera.port}"]
        if self.force is not None:
            places.append(f"force on {self.force.port}")
        if self.ink is not None:
            places.append(f"ink on {self.ink.path}")
        return ", ".join(places)

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
        self.camera.show(self.scene, config.view)

    async def idle(self, seconds: float) -> None:
        """Return once no client has been connected for `seconds`."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while loop.time() - since < seconds:
            if any(server.clients for server, _ in self._servers()):
                since = loop.time()
            await asyncio.sleep(0.2)


def _force(world: World) -> SocketcandServer:
    config = world.config
    board = ForceBoard(
        lambda _t_s: _at_sensor(world.config, world.wrench()),
        noise_n=config.force_noise_n,
        noise_nm=config.force_noise_nm,
        seed=config.seed,
    )
    return SocketcandServer(board, world.clock.now_s, rate_hz=config.force_hz)


def _at_sensor(config: SimConfig, wrench: Wrench) -> Wrench:
    """The wrench as the sensor reports it, whose axes and sign depend on how it is mounted."""
    about_x, about_y = (math.radians(v) for v in config.tool_lean_deg)
    sensor = of_angles(0.0, 0.0, math.radians(config.sensor_turn_deg))
    brush_in_sensor = product(inverse(sensor), of_angles(about_x, about_y, 0.0))
    force_n, torque_nm = (turned(brush_in_sensor, part) for part in (wrench[:3], wrench[3:]))
    fx, fy, fz, mx, my, mz = (config.sensor_sign * value for value in (*force_n, *torque_nm))
    return fx, fy, fz, mx, my, mz


def _ink(world: World) -> PtyLine | None:
    match world.config.ink_device:
        case "station":
            return PtyLine(StationFirmware(world.well))
        case "pump":
            pumped = world.well.add
            return PtyLine(PumpFirmware(ml_per_revolution=PUMP_ML, reservoir_ml=PUMP_RESERVOIR_ML, on_pumped=pumped))
        case "none":
            return None
