"""The neural stroke generator (the paper's CCD-BSMG): what it learns to draw, the network, and its outlines."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

SHIPPED_GENERATOR = Path(__file__).parent / "data" / "generator.safetensors"
"""The generator that comes with brushloop; its card beside it says what it was trained on, and by which command."""


class TrainError(Exception):
    """A generator, a checkpoint, a configuration or a set of captures that cannot be used."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path | str, what: str) -> None:
        self.path = str(path)
        self.what = what
        super().__init__(f"{path}: {what}")
