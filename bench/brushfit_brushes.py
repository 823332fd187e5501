"""The brushes of `bench brushfit`: frozen before any score of a fitted model was looked at, never tuned to one.

They differ in size, stiffness, friction and set within what the simulated brush allows. Change none of them: a new idea
gets a new list. The fit was developed on `DEVELOPMENT` and scored on `FROZEN`.
"""

from __future__ import annotations

from drivers.sim.brush import BrushSpec

FROZEN: tuple[BrushSpec, ...] = (
    BrushSpec(seed=11),
    BrushSpec(radius_mm=5.0, length_mm=42.0, stiffness_n_mm2=150.0, friction=0.18, set_deg=10.0, seed=12),
    BrushSpec(radius_mm=7.0, length_mm=52.0, stiffness_n_mm2=260.0, friction=0.25, set_deg=6.0, seed=13),
    BrushSpec(
        radius_mm=6.0,
        length_mm=44.0,
        stiffness_n_mm2=320.0,
        stiffness_power=3.2,
        squash_n_per_mm2=0.012,
        friction=0.15,
        seed=14,
    ),
    BrushSpec(length_mm=50.0, stiffness_n_mm2=120.0, suction_n_per_mm2=0.002, friction=0.3, set_deg=12.0, seed=15),
)
DEVELOPMENT: tuple[BrushSpec, ...] = (
    BrushSpec(seed=1),
    BrushSpec(radius_mm=5.5, length_mm=46.0, stiffness_n_mm2=240.0, friction=0.2, seed=2),
)
