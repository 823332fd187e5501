"""Configuration of the loopback rig: the true values, which the software under test may learn only by measuring."""

import math
from dataclasses import dataclass, field
from typing import Literal

from brushloop.drivers.sim.brush.brush_file import SoundHead
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import BrushSpec

Place = tuple[float, float, float]
"""x, y, z in the base frame, in mm."""
CORNERS = ("lower left", "lower right", "upper right", "upper left")
"""Of the board and of the sheet, with the print upright before the reader."""


@dataclass(frozen=True, slots=True)
class Table:
    """Where the sheet, the board and the ink well lie. The paper frame is right-handed, z up, in mm."""

    origin_mm: tuple[float, float] = (460.0, -110.0)
    """Lower left corner of the sheet in the robot's base frame."""
    yaw_deg: float = 90.0
    """Angle from base x to paper x. Not zero, so that a forgotten rotation shows at once."""
    paper_z_mm: float = 120.0
    """Height of the sheet at its origin; the well stands at this height too."""
    slope_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation of the sheet about paper x (its far edge rises) and about paper y (its right edge falls)."""
    sheet_mm: tuple[float, float] = (244.0, 172.0)
    board_origin_mm: tuple[float, float] = (-34.0, -34.0)
    """Lower left corner of the ChArUco board, in the paper frame. The sheet lies on it, so that corners are seen on
    all sides: a plane fitted to a strip at one side would be extrapolated over the whole sheet."""
    board_squares: tuple[int, int] = (26, 20)
    board_square_mm: float = 12.0
    board_marker_mm: float = 9.0
    board_dictionary: str = "DICT_5X5_1000"
    well_mm: tuple[float, float] = (-75.0, 150.0)
    """Centre of the ink well, in the paper frame: on the way from where the arm parks to the sheet."""
    well_radius_mm: float = 15.0
    well_depth_mm: float = 14.0
    """Depth from its rim to its bottom, which stands on the table at the height of the paper."""
    ink_level_mm: float = 10.0
    """Ink surface above the paper plane when the rig starts."""

    @property
    def board_size_mm(self) -> tuple[float, float]:
        """True width and height of the printed board."""
        columns, rows = self.board_squares
        return columns * self.board_square_mm, rows * self.board_square_mm

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit vector out of the sheet, in the paper frame (whose z is the base frame's)."""
        about_x, about_y = (math.tan(math.radians(v)) for v in self.slope_deg)
        length = math.sqrt(1.0 + about_x**2 + about_y**2)
        return about_y / length, -about_x / length, 1.0 / length

    def to_paper(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Convert x and y from the base frame to the paper frame."""
        dx, dy = x_mm - self.origin_mm[0], y_mm - self.origin_mm[1]
        yaw = math.radians(self.yaw_deg)
        return math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy

    def to_base(self, x_mm: float, y_mm: float, above_mm: float = 0.0) -> Place:
        """A point of the paper frame, `above_mm` above the sheet, in the base frame."""
        yaw = math.radians(self.yaw_deg)
        return (
            self.origin_mm[0] + math.cos(yaw) * x_mm - math.sin(yaw) * y_mm,
            self.origin_mm[1] + math.sin(yaw) * x_mm + math.cos(yaw) * y_mm,
            self.surface_z_mm(x_mm, y_mm) + above_mm,
        )

    def over_sheet(self, above_mm: float = 0.0) -> Place:
        """The middle of the sheet, or a place above it."""
        width, height = self.sheet_mm
        return self.to_base(width / 2, height / 2, above_mm)

    def corner(self, of: str, name: str) -> Place:
        """A corner of the `board` or of the `sheet`. Raises ValueError for an unknown name."""
        if name not in CORNERS:
            raise ValueError(f"corner = {name!r} is not one of {', '.join(CORNERS)}")
        left, bottom = self.board_origin_mm if of == "board" else (0.0, 0.0)
        width, height = self.board_size_mm if of == "board" else self.sheet_mm
        return self.to_base(left + width * ("right" in name), bottom + height * ("upper" in name))

    def surface_z_mm(self, x_mm: float, y_mm: float) -> float:
        """Height of the sheet at a point of the paper frame, in the base frame."""
        nx, ny, nz = self.normal
        return self.paper_z_mm - (nx * x_mm + ny * y_mm) / nz


@dataclass(frozen=True, slots=True)
class View:
    """The camera: its place, its picture and its errors."""

    width_px: int = 2048
    height_px: int = 1536
    px_per_mm: float = 6.25
    keystone: float = 0.012
    """Relative change of scale from one edge of the image to the other."""
    turn_deg: float = 0.6
    centre_mm: tuple[float, float] = (122.0, 86.0)
    """The point of the paper plane in the middle of the image, in the paper frame."""
    lens_mm: tuple[float, float, float] | None = None
    """Place of a pinhole over the sheet, in the paper frame: it determines the perspective. If it is None, `px_per_mm`
    and `keystone` do."""
    focal: float = 1.0
    """Focal length, in image widths."""
    mirrored: bool = False
    """The picture is mirrored left to right, as some cameras' drivers do by default."""
    noise: float = 2.0
    """Standard deviation of the noise, in gray levels."""
    shade: float = 0.18
    """Fall-off of the light toward one corner."""
    shadow: float = 0.0
    """Light that a soft-edged shadow across the sheet takes away, 0 to 1."""
    k1: float = 0.0
    """First radial distortion coefficient of OpenCV's lens model."""
    blur_px: float = 0.7
    fps: float = 8.0
    delay_s: float = 0.0
    """Real seconds that a picture waits before it is sent, on top of drawing and coding it."""
    delay_jitter_s: float = 0.0
    """Largest random extra delay; pictures never overtake each other."""


@dataclass(frozen=True, slots=True)
class SimConfig:
    """One loopback rig."""

    seed: int = 1
    rate: float = 1.0
    """Simulated seconds per real second."""
    home_mm: Place = (250.0, -230.0, 260.0)
    """Where the tip rests when the rig starts, in the base frame."""
    ink_device: Literal["station", "pump", "none"] = "station"
    """The device at the well: an ink station, a Modbus pump, or none (a person with a bottle)."""
    force_sensor: bool = True
    """Whether a force sensor sits between flange and brush."""
    force_hz: float = 200.0
    """Rounds per real second."""
    force_noise_n: float = 0.002
    """Standard deviation of each round: that of a sensor for a few N, which a soft brush needs."""
    force_noise_nm: float = 2e-4
    hanging_kg: float = 0.12
    """Mass of holder and brush below the sensor."""
    tool_mm: float = 180.0
    """True length from the flange to the tip, along the flange's z; an operator measures and configures it."""
    tool_sideways_mm: tuple[float, float] = (0.0, 0.0)
    """True place of the tip along the flange's x and y."""
    tool_lean_deg: tuple[float, float] = (0.0, 0.0)
    """True turn of the brush about the flange's x, then its y: a holder that is not square to the flange."""
    sensor_turn_deg: float = 0.0
    """How the force sensor is mounted: its turn about the flange's z."""
    sensor_sign: Literal[1, -1] = 1
    """-1 for a sensor that reports the push of the tool on the paper instead of the paper's on the tool."""
    brush: BrushSpec = field(default_factory=BrushSpec)
    misfit: Misfit | None = None
    brush_name: str = ""
    """Name of the brush in recordings; if empty, "simulated bristle bundle" and its seed."""
    head: SoundHead | None = None
    """Where sound marks of the brush begin; None for the default of `rig.toml`."""
    table: Table = field(default_factory=Table)
    view: View = field(default_factory=View)
