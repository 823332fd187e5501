"""The neural stroke generator (the paper's CCD-BSMG): its training, and its images and outlines in numpy.

Only `train` loads torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

SHIPPED_GENERATOR = Path(__file__).parent / "data" / "generator.safetensors"
"""The generator that comes with brushloop; its card beside it says what it was trained on, and by which command."""


class TrainError(Exception):
    """A generator, checkpoint, configuration or captures that cannot be used, or a training that fails with them."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path | str, what: str) -> None:
        self.path = str(path)
        self.what = what
        super().__init__(f"{path}: {what}")
