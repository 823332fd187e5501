"""The tables of the CCD-BSMG paper, in percent; the paper used its own brush, ink and preprocessing."""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]
"""Max, min, avg."""


@dataclass(frozen=True, slots=True)
class Printed:
    """One row as the paper prints it."""

    label: str
    csim: Triple
    ssim: Triple


ROBOT_WRITING = "robot writing"
TABLE_1: dict[str, Printed] = {
    "ccd-bsm": Printed("CCD-BSM", (94.25, 88.33, 91.84), (90.13, 85.16, 87.71)),
    "ccd-bsmg": Printed("CCD-BSMG", (97.29, 89.22, 92.65), (90.58, 85.49, 88.16)),
    ROBOT_WRITING: Printed("robot writing", (98.21, 89.42, 93.31), (95.62, 85.85, 90.12)),
}
"""Generated strokes, and strokes pressed again with the recovered (H, alpha), against real strokes."""
TABLE_2: dict[str, Printed] = {
    "ccd-bsmg": TABLE_1["ccd-bsmg"],
    "ccd-bsm": TABLE_1["ccd-bsm"],
    "bezier": Printed("Bézier", (90.36, 85.48, 88.02), (83.14, 78.21, 81.03)),
    "ellipse": Printed("Ellipse", (86.43, 81.62, 84.15), (76.81, 71.05, 73.46)),
    "circle": Printed("Circle", (71.40, 64.36, 67.03), (63.85, 57.21, 60.23)),
    "line": Printed("Line", (85.99, 81.26, 83.50), (77.38, 67.22, 72.77)),
}
"""Every model against real strokes."""
TABLE_3: dict[str, Printed] = {
    "ccd-bsmg": Printed("CCD-BSMG", (97.71, 91.45, 94.58), (79.26, 72.56, 75.91)),
    ROBOT_WRITING: Printed("robot writing", (95.82, 91.36, 93.59), (78.78, 70.42, 74.60)),
}
"""The character zi. The paper does not say what each row was compared with, nor whether it wrote 字 or 子, nor its
polarity: the pairing of its rows with ours is our interpretation."""
ORDER = ("ccd-bsmg", "ccd-bsm", "bezier", "ellipse", "line", "circle")
"""Models by average CSIM and SSIM, best first, as the paper states it."""
