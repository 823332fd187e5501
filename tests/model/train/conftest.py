"""A training so small that it takes a second."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from brushloop.model.train.checkpoint import State
from brushloop.model.train.config import TrainConfig, checked
from brushloop.model.train.loop import Validation

TINY: dict[str, Any] = {
    "target": {"ranges": {"depth_mm": [11, 20], "tilt_deg": [0, 10]}, "px_mm": 0.8, "size_px": 32},
    "layers": {"width": 16, "channels": 4, "side": 8},
    "training_images": 96,
    "validation_images": 16,
    "batch": 16,
    "steps": 30,
    "validate_every": 10,
    "checkpoint_every": 10,
    "picture_every": 15,
}


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def tiny() -> TrainConfig:
    return checked("tiny", TINY)


class Notes:
    """A watcher that keeps what is reported to it."""

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.validations: list[Validation] = []
        self.shown: list[int] = []
        self.states: dict[int, State] = {}

    def stepped(self, step: int, loss: float) -> None:
        self.losses.append(loss)

    def validated(self, validation: Validation) -> None:
        self.validations.append(validation)

    def pictures(self, step: int, inputs: Tensor, targets: Tensor, drawn: Tensor) -> None:
        assert inputs.shape[0] == targets.shape[0] == drawn.shape[0] == 8
        self.shown.append(step)

    def checkpoint(self, state: State) -> None:
        self.states[state.step] = state


@pytest.fixture
def notes() -> Notes:
    return Notes()


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    """The same training as a file."""
    return write_toml(tmp_path)


@pytest.fixture(scope="session")
def write_tiny() -> Callable[[Path], Path]:
    """Writes that file into a folder, for fixtures that outlive a test."""
    return write_toml


def write_toml(folder: Path) -> Path:
    target = "ranges = {depth_mm = [11, 20], tilt_deg = [0, 10]}\npx_mm = 0.8\nsize_px = 32\n"
    layers = "width = 16\nchannels = 4\nside = 8\n"
    numbers = "".join(f"{name} = {value}\n" for name, value in TINY.items() if isinstance(value, int))
    path = folder / "train.toml"
    path.write_text(f"{numbers}[target]\n{target}[layers]\n{layers}")
    return path
