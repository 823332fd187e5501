"""The `rig.toml` of the loopback rig: as an operator would have taught it, small errors included."""

from __future__ import annotations

from dataclasses import dataclass

from brushloop.drivers.force.rounds import LOOPBACK_CHANNEL
from brushloop.drivers.sim.config import SimConfig

LOOPBACK_HEAD = "# The loopback rig"
TAUGHT_TOUCH_ERROR_MM = 0.03
"""Error of a taught touch height."""
SEEN_S = 0.05
"""Real time within which a pose is seen by polling."""
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
{_ink_device(config, at)}{_force(config, at)}
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
{_dwell(config)}{_quality(config)}"""


def _ink_device(config: SimConfig, at: Addresses) -> str:
    match config.ink_device:
        case "station":
            return f'\n[ink.device]\nkind = "ink-station"\nport = "{at.ink_path}"\nlight = 0.8\n'
        case "pump":
            return f'\n[ink.device]\nkind = "modbus-pump"\nport = "{at.ink_path}"\nml_per_revolution = {PUMP_ML}\n'
        case "none":
            return ""


def _force(config: SimConfig, at: Addresses) -> str:
    if at.force_port is None:
        return ""
    return f"""
[force]
kind = "sri-m8123"
interface = "socketcand"
channel = "{LOOPBACK_CHANNEL}"
host = "{at.host}"
port = {at.force_port}
{_staleness(config)}"""


def _dwell(config: SimConfig) -> str:
    """`least_dwell_s` if simulated time runs fast: else a whole dwell could pass between two polls."""
    if config.rate <= 2.0:
        return ""
    return f"least_dwell_s = {SEEN_S * config.rate:g}    # simulated time runs at {config.rate:g} times real time\n"


def _staleness(config: SimConfig) -> str:
    """`stale_ms` of a real sensor; more if simulated time is fast: a sample's age then says little about the arm."""
    if config.rate <= 1.0:
        return "stale_ms = 100.0\n"
    return f"stale_ms = 1000.0    # allowed on this bus alone: simulated time runs at {config.rate:g} times real time\n"


def _quality(config: SimConfig) -> str:
    if config.head is None:
        return ""
    return f"""
[quality]
head_mm = {config.head.head_mm}
misplaced_mm = {config.head.misplaced_mm}
"""
