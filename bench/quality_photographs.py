"""What the quality checks call real photographs of single strokes: `python -m bench.quality_photographs FOLDER`.

The folder holds a table `strokes.csv` with file, px_per_mm_x, px_per_mm_y, start_x_px and start_y_px.
"""

from __future__ import annotations

import csv
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bench.harness import BenchError
from brushloop.calibrate.board.lens import unknown_lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.collect.quality.checks import check_capture
from brushloop.collect.quality.verdict import Failure, Verdict
from brushloop.collect.rig.config_quality import QualityConfig
from brushloop.collect.rig.paper import Patch

WHITENED = QualityConfig(bright_level=256.0, glare_mm2=1e6)
"""For paper that whoever published it has set to 255: neither exposure nor glare can be judged."""
INK = (Failure.NEIGHBOUR, Failure.BLANK, Failure.DRY, Failure.FAINT)
"""What can be asked of a drag: its place and its shape are not those of a press."""
DEPTH_MM = 9.0
"""For rows of the table without a depth."""


def rows(folder: Path) -> list[dict[str, str]]:
    """The table of a folder."""
    with (folder / "strokes.csv").open() as file:
        return list(csv.DictReader(file))


def judge(folder: Path, row: dict[str, str], limits: QualityConfig) -> Verdict:
    """The verdict on one photograph as a whole, as if it were a patch. Raises BenchError where it cannot be read."""
    image = cv2.imread(str(folder / row["file"]), cv2.IMREAD_GRAYSCALE)
    if image is None:  # pyright: ignore[reportUnnecessaryComparison]
        raise BenchError(f"{folder / row['file']} is no picture")
    x_mm, y_mm = 1.0 / float(row["px_per_mm_x"]), 1.0 / float(row["px_per_mm_y"])
    size_x_mm, size_y_mm = image.shape[1] * x_mm, image.shape[0] * y_mm
    to_paper = np.array([[x_mm, 0.0, 0.5 * x_mm], [0.0, -y_mm, size_y_mm - 0.5 * y_mm], [0.0, 0.0, 1.0]])
    scale = float(np.sqrt(x_mm * y_mm))
    return check_capture(
        image.astype(np.uint8),
        Plane(
            unknown_lens((image.shape[1], image.shape[0])),
            to_paper,
            scale,
            (scale, scale),
            rms_px=0.0,
            distortion_px=0.0,
            middle_px=(0.0, 0.0),
            corners=0,
            dropped=(),
        ),
        Patch(0, 0.0, 0.0, size_x_mm, size_y_mm),
        depth_mm=max(float(row.get("depth_mid_mm_nominal") or DEPTH_MM), 1.0),
        limits=limits,
        sheet_mm=(size_x_mm, size_y_mm),
        anchor_mm=(float(row["start_x_px"]) * x_mm, size_y_mm - float(row["start_y_px"]) * y_mm),
    )


def named(verdict: Verdict, among: Sequence[Failure] = tuple(Failure)) -> str:
    """The first failure among those asked for, in a word."""
    failed = [check.name for check in verdict.checks if not check.passed and check.name in among]
    return str(failed[0]) if failed else "sound"


def main(arguments: Sequence[str]) -> None:
    """Count the verdicts three ways: as they are, without exposure and glare, and of the ink alone."""
    folder = Path(arguments[0])
    as_is, whitened, ink = Counter[str](), Counter[str](), Counter[str]()
    for row in rows(folder):
        as_is[named(judge(folder, row, QualityConfig()))] += 1
        verdict = judge(folder, row, WHITENED)
        whitened[named(verdict)] += 1
        ink[named(verdict, INK)] += 1
    for words, counts in (("as they are", as_is), ("without exposure and glare", whitened), ("ink alone", ink)):
        sys.stdout.write(f"{words}: {', '.join(f'{name} {count}' for name, count in counts.most_common())}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
