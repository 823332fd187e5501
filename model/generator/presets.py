"""The targets that a generator is trained on by name, as (model, ranges, fixed, placement, mm per pixel)."""

from __future__ import annotations

from dataclasses import dataclass, field

from model.generator.network import Layers
from model.generator.targets import Placement

_PRESS = {"height_mm": (11.0, 20.0), "tilt_deg": (0.0, 10.0)}
"""The paper's ranges of H and alpha."""


@dataclass(frozen=True, slots=True)
class Preset:
    """What a target is by default, and a network that fits it."""

    model: str
    ranges: dict[str, tuple[float, float]]
    placement: Placement
    px_mm: float
    layers: Layers
    fixed: dict[str, float] = field(default_factory=dict[str, float])
    rate: float = 3e-3
    """Learning rate."""


PRESETS: dict[str, Preset] = {
    "press": Preset("ccd-bsm", _PRESS, Placement.CENTRED, 0.2, Layers(), rate=5e-3),
    "anchored": Preset("ccd-bsm", _PRESS, Placement.ZERO_TOUCH, 0.3, Layers(), rate=5e-3),
    "all": Preset(
        "ccd-bsm",
        {
            "length_mm": (44.0, 52.0),
            "radius_mm": (5.0, 7.0),
            **_PRESS,
            "base_x_mm": (26.0, 32.0),
            "base_y_mm": (16.2, 22.2),
        },
        Placement.BASE,
        0.3,
        Layers(width=384, depth=3, channels=32, hidden_channels=64),
    ),
    "qbc": Preset(
        "qbc",
        {
            "x0_mm": (-17.0, -12.0),
            "y0_mm": (-7.8, 7.8),
            "x1_mm": (-11.0, -3.4),
            "y1_mm": (-7.8, 7.8),
            "x2_mm": (-2.4, 2.6),
            "y2_mm": (-7.8, 7.8),
            "start_width_mm": (1.0, 5.0),
            "end_width_mm": (1.0, 5.0),
        },
        Placement.BASE,
        0.2,
        Layers(width=384, depth=3, channels=32, hidden_channels=64),
        {"base_x_mm": 20.0, "base_y_mm": 12.8},
    ),
    "bezier": Preset(
        "bezier",
        {"tip_mm": (11.0, 22.0), "base_mm": (1.0, 2.6), "belly_mm": (8.0, 16.0), "shoulder": (0.2, 0.9)},
        Placement.CENTRED,
        0.2,
        Layers(),
    ),
}
"""`press`: (H, alpha), as the paper's section IV-B. `all`: the paper's M = {L, R, H, alpha} and (x0, y0).
`anchored`: (H, alpha) on the validation's millimetre field. `qbc`, `bezier`: the ablation of its figure 12."""
