"""The brushes of `bench brushfit`: frozen before any score of a fitted model was looked at, never tuned to one.

They differ in size, stiffness, friction and set within what the simulated brush allows. Change none of them: a new idea
gets a new list. The fit was developed on `DEVELOPMENT` and scored on `FROZEN`: with its first form, and once more when
the lean had been added to it.
"""

from __future__ import annotations

from brushloop.drivers.sim.brush.brush import BrushSpec

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
    *(
        BrushSpec(
            radius_mm=radius,
            length_mm=length,
            stiffness_n_mm2=stiffness,
            stiffness_power=power,
            suction_n_per_mm2=suction,
            friction=friction,
            set_deg=set_deg,
            seed=seed,
        )
        for radius, length, stiffness, power, suction, friction, set_deg, seed in (
            (6.57, 47.5, 169.0, 3.4, 0.0, 0.198, 8.3, 21),
            (5.18, 45.7, 278.0, 3.66, 0.002, 0.241, 6.8, 22),
            (5.72, 50.7, 316.0, 3.62, 0.0, 0.174, 11.3, 23),
            (5.68, 45.5, 198.0, 3.27, 0.0, 0.178, 10.5, 24),
            (5.15, 45.9, 121.0, 3.48, 0.002, 0.163, 6.2, 25),
            (5.41, 50.1, 174.0, 3.68, 0.002, 0.216, 10.0, 26),
            (5.84, 51.2, 224.0, 3.7, 0.002, 0.269, 10.3, 31),
            (5.76, 45.2, 236.0, 3.6, 0.002, 0.293, 9.0, 32),
            (6.43, 49.1, 294.0, 3.34, 0.002, 0.296, 8.5, 33),
        )
    ),
)
"""Two by hand, nine drawn at random within the ranges that the frozen ones span; the last three have much friction."""
