"""What is drawn of a training: loss curves (the paper's figure 9), pictures every m steps, and TensorBoard's events."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from torch import Tensor

from model.protocol import ParameterSpec
from model.train.checkpoint import COLUMNS, State, write_whole
from model.train.errors import MissingExtra


def write_curves(folder: Path, state: State, title: str) -> None:
    """Write `loss.png`, and `loss.csv` and `validation.csv` with every number in it. Raises OSError."""
    from matplotlib.figure import Figure

    losses = state.losses.double().numpy()
    checks = state.validations.numpy()
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = np.arange(1, len(losses) + 1)
    left.semilogy(steps, losses, color="0.75", linewidth=0.6, label="each step")
    if len(losses) > 50:
        smooth = np.convolve(losses, np.full(50, 1 / 50), "valid")
        left.semilogy(steps[49:], smooth, color="black", linewidth=1, label="mean of 50 steps")
    left.set(title="(a) training loss", xlabel="step", ylabel="MSE, Eq. 6")
    left.legend()
    right.semilogy(checks[:, 0], checks[:, 1], color="black", marker=".", linewidth=1)
    right.set(title="(b) validation loss", xlabel="step", ylabel="MSE")
    figure.suptitle(title)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100)
    write_whole(folder / "loss.png", out.getvalue())
    write_whole(folder / "loss.csv", _table(("step", "loss"), zip(steps.tolist(), losses.tolist(), strict=True)))
    write_whole(folder / "validation.csv", _table(COLUMNS, ([int(row[0]), *row[1:]] for row in checks.tolist())))


def write_pictures(
    path: Path, specs: tuple[ParameterSpec, ...], inputs: Tensor, targets: Tensor, drawn: Tensor
) -> None:
    """Write targets above what the generator draws, a column a stroke, as PNG. Raises OSError."""
    from matplotlib.figure import Figure

    count = len(inputs)
    figure = Figure(figsize=(1.6 * count, 3.8))
    figure.subplots_adjust(0.04, 0.01, 0.99, 0.88, 0.04, 0.04)  # a computed layout takes seconds for so many axes
    axes: Any = figure.subplots(2, count, squeeze=False)
    for k in range(count):
        values = [f"{spec.name} {float(value):.3g}" for spec, value in zip(specs, inputs[k], strict=True)][:4]
        axes[0, k].set_title("\n".join(values), fontsize=6)
        for row, image in enumerate((targets[k], drawn[k])):
            axes[row, k].imshow(1 - image.numpy(), cmap="gray", vmin=0, vmax=1)
            axes[row, k].set(xticks=[], yticks=[])
    axes[0, 0].set_ylabel("target")
    axes[1, 0].set_ylabel("generator")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100)
    write_whole(path, out.getvalue())


class Events:
    """TensorBoard's event files; steps after `step` of an earlier, killed run are hidden. Raises MissingExtra."""

    def __init__(self, folder: Path, step: int) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise MissingExtra("tensorboard", "train") from error
        untyped: Any = SummaryWriter
        self._writer: Any = untyped(log_dir=str(folder), purge_step=step)

    def scalar(self, name: str, value: float, step: int) -> None:
        """Note one number."""
        self._writer.add_scalar(name, value, step)

    def __enter__(self) -> Events:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()


def _table(head: tuple[str, ...], rows: Any) -> bytes:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue().encode()
