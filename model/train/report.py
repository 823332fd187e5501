"""Reports of a training: loss curves (the paper's figure 9), pictures, samples, model card."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from brushloop.model.protocol import ParameterSpec
from brushloop.model.train.checkpoint import COLUMNS, State, read_tensors, sha256, write_whole
from brushloop.model.train.config import TrainConfig
from brushloop.model.train.errors import TrainError


def write_curves(folder: Path, state: State, title: str) -> None:
    """Write `loss.png`, and its numbers as `loss.csv` and `validation.csv`. Raises OSError."""
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
    """Write a PNG of targets above generated images, one column per stroke. Raises OSError."""
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


SAMPLES = "samples.safetensors"
MOST_SAMPLES = 12
_MAX_SAMPLES_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Some validation strokes: `inputs` (n, P), `targets` and `drawn` (n, N, N) uint8 with ink = 255."""

    inputs: Tensor
    targets: Tensor
    drawn: Tensor


def save_samples(folder: Path, samples: Samples) -> None:
    """Write `samples.safetensors`. Raises OSError."""
    tensors = {name: getattr(samples, name).contiguous() for name in ("inputs", "targets", "drawn")}
    write_whole(folder / SAMPLES, save(tensors))


def load_samples(folder: Path, count: int) -> Samples:
    """Read the samples of a generator with `count` inputs; none where there is no file. Raises TrainError."""
    path = folder / SAMPLES
    if not path.exists():
        return Samples(torch.zeros((0, count)), *torch.zeros((2, 0, 1, 1), dtype=torch.uint8))
    _, tensors = read_tensors(path, _MAX_SAMPLES_BYTES)
    inputs, targets, drawn = (tensors.get(name) for name in ("inputs", "targets", "drawn"))
    if inputs is None or targets is None or drawn is None:
        raise TrainError(path, "does not hold inputs, targets and drawn")
    if inputs.shape != (len(targets), count) or not inputs.is_floating_point():
        raise TrainError(path, f"inputs is not {len(targets)} x {count} floating-point numbers")
    if targets.ndim != 3 or targets.shape != drawn.shape or {targets.dtype, drawn.dtype} != {torch.uint8}:
        raise TrainError(path, "targets and drawn are not uint8 images of one size")
    return Samples(inputs, targets, drawn)


def _table(head: tuple[str, ...], rows: Any) -> bytes:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue().encode()


_NUMBERS = (("MSE", "mse", ".3g"), ("PSNR, dB", "psnr_db", ".2f"), ("IoU", "iou", ".5f"), ("CSIM", "csim", ".5f"))
_NUMBERS += (("SSIM, mean", "ssim", ".5f"), ("SSIM, least", "ssim_min", ".5f"))


def write_card(path: Path, config: TrainConfig, report: dict[str, Any]) -> None:
    """Write the card of the generator at `path` beside it, as `<stem>.md`; raises OSError."""
    write_whole(path.with_suffix(".md"), card_text(path, config, report).encode())


def card_text(path: Path, config: TrainConfig, report: dict[str, Any]) -> str:
    """The card as Markdown."""
    target, tuning = config.target, config.tuning
    side_mm = target.size_px * target.px_mm
    lines = [
        f"# {path.name}",
        "",
        f"A network that draws the press of a brush, trained on exact area coverage of the stroke model "
        f"`{target.model}`{' and tuned on captured strokes' if tuning else ''}.",
        "",
        f"- Content: sha256 `{sha256(path)}`",
        f"- Image: {target.size_px} x {target.size_px} px of {target.px_mm:g} mm ({side_mm:g} mm a side), ink 1 on 0, "
        f"placement `{target.placement}`, heading 0",
        f"- Brush: R {target.radius_mm:g} mm, L {target.length_mm:g} mm, lambda {target.lam:.5g}"
        + (" (fitted to captures)" if target.fitted_brush else ""),
        f"- Network: {config.weight_count():,} weights, {config.layers.model_dump()}",
        f"- Training: {report.get('steps')} steps of {config.batch}, seed {config.seed}, {report.get('end')}; "
        f"{report.get('cpu_s')} s of CPU time since the last start; torch {report.get('torch')}",
        "",
        "| input | unit | from | to | meaning |",
        "|---|---|---|---|---|",
    ]
    for spec in config.build_target().inputs:
        lines.append(f"| `{spec.name}` | {spec.unit} | {spec.low:g} | {spec.high:g} | {spec.meaning} |")
    images = "captured strokes that were held out" if tuning else "exact images that it was not trained on"
    lines += ["", f"On {report.get('images')} {images} ({report.get('ssim_settings')}):", "", "| | |", "|---|---|"]
    for label, key, form in _NUMBERS:
        value = report.get(key)
        if isinstance(value, int | float):
            lines.append(f"| {label} | {value:{form}} |")
    lines += ["", "## Limits", ""]
    if tuning:
        lines += [
            f"- Tuned on captures of: {_plain(tuning.source)}. Other captures of that kind are not a blind test.",
            f"- Started from a generator with sha256 `{tuning.start_sha256}`; captures `{tuning.captures_sha256}`.",
        ]
    else:
        lines.append(
            "- It has seen no real ink: it reproduces a closed-form model, and is no better on paper than that."
        )
    lines.append("- Outside the ranges above it extrapolates polynomials: do not use it there.")
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Text from a file, without characters that Markdown or HTML would interpret."""
    return "".join(c if c.isalnum() or c in " .,-_()/:" else "?" for c in text)
