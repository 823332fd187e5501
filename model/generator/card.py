"""What a training writes for people: how close the images are, loss curves, pictures, samples, and the model card."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from brushloop.model.generator import TrainError
from brushloop.model.generator.config import INPUTS, TrainConfig
from brushloop.model.generator.data import sha256, write_whole
from brushloop.model.generator.stroke import read_tensors
from brushloop.model.similarity import SSIM_SETTINGS, binary_scores, csim, ssim

Floats = NDArray[np.floating[Any]]
COLUMNS = ("step", "mse", "iou", "csim")
"""Columns of the validation history."""
NUMBERS = (("MSE", "mse", ".3g"), ("PSNR, dB", "psnr_db", ".2f"), ("IoU", "iou", ".5f"), ("CSIM", "csim", ".5f"),
           ("SSIM, mean", "ssim", ".5f"), ("SSIM, least", "ssim_min", ".5f"))  # fmt: skip
"""Label, name and format of the numbers of a report."""


def likeness(drawn: Floats, target: Floats) -> NDArray[np.float64]:
    """MSE, IoU and CSIM of (B, N, N) images in [0, 1], (B, 3); IoU counts the pixels that are mostly ink.

    A blank image has a CSIM of 0.
    """
    mse = np.square(np.subtract(drawn, target, dtype=np.float64)).mean((1, 2))
    iou = binary_scores(drawn > 0.5, target > 0.5)[:, 1]
    alike = [csim(a, b) if a.any() and b.any() else 0.0 for a, b in zip(drawn, target, strict=True)]
    return np.column_stack((mse, iou, alike))


def report_of(pairs: Iterable[tuple[Floats, Floats]]) -> dict[str, Any]:
    """Means over (drawn, target) batches, and the least SSIM. Raises ValueError if there are no images."""
    rows: list[NDArray[np.float64]] = []
    structures: list[float] = []
    for drawn, target in pairs:
        rows.append(likeness(drawn, target))
        structures += [ssim(a, b) for a, b in zip(drawn, target, strict=True)]
    if not rows:
        raise ValueError("no images to compare")
    mse, iou, alike = np.concatenate(rows).mean(0).tolist()
    psnr_db = 10 * math.log10(1 / mse) if mse else math.inf
    report = {"images": len(structures), "mse": mse, "psnr_db": psnr_db, "iou": iou, "csim": alike}
    return report | {"ssim": float(np.mean(structures)), "ssim_min": min(structures), "ssim_settings": SSIM_SETTINGS}


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Some validation strokes: `inputs` (n, 2), `targets` and `drawn` (n, N, N) in [0, 1]."""

    inputs: Floats
    targets: Floats
    drawn: Floats


SAMPLES = "samples.safetensors"
_MAX_SAMPLES_BYTES = 16 * 1024 * 1024


def save_samples(folder: Path, samples: Samples) -> None:
    """Write `samples.safetensors`, images as uint8. Raises OSError."""
    images = {name: np.rint(255 * np.clip(getattr(samples, name), 0, 1)) for name in ("targets", "drawn")}
    tensors = {"inputs": np.asarray(samples.inputs, np.float32)}
    write_whole(folder / SAMPLES, save(tensors | {name: value.astype(np.uint8) for name, value in images.items()}))


def load_samples(folder: Path) -> Samples:
    """Read the samples of a generator; none where there is no file. Raises TrainError."""
    path = folder / SAMPLES
    if not path.exists():
        return Samples(np.zeros((0, len(INPUTS))), np.zeros((0, 1, 1)), np.zeros((0, 1, 1)))
    _, tensors = read_tensors(path, _MAX_SAMPLES_BYTES)
    inputs, targets, drawn = (tensors.get(name, np.zeros(0)) for name in ("inputs", "targets", "drawn"))
    if inputs.shape != (len(targets), len(INPUTS)) or inputs.dtype.kind != "f":
        raise TrainError(path, f"inputs is not {len(targets)} x {len(INPUTS)} floating-point numbers")
    if targets.ndim != 3 or targets.shape != drawn.shape or {targets.dtype, drawn.dtype} != {np.dtype(np.uint8)}:
        raise TrainError(path, "targets and drawn are not uint8 images of one size")
    return Samples(inputs, *(images.astype(np.float32) / np.float32(255) for images in (targets, drawn)))


def write_curves(folder: Path, losses: Sequence[float], validations: Sequence[Sequence[float]]) -> None:
    """Write the numbers of the paper's figure 9 as `loss.csv` and `validation.csv`. Raises OSError."""
    for name, head, rows in (
        ("loss.csv", ("step", "loss"), enumerate(losses, 1)),
        ("validation.csv", COLUMNS, validations),
    ):
        lines = [head, *rows]
        write_whole(folder / name, "".join(f"{','.join(map(str, line))}\n" for line in lines).encode())


def read_curves(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Losses (steps,) and validations (k, 4) as `write_curves` wrote them. Raises TrainError."""
    try:
        losses = np.loadtxt(folder / "loss.csv", delimiter=",", skiprows=1, ndmin=2)
        checks = np.loadtxt(folder / "validation.csv", delimiter=",", skiprows=1, ndmin=2)
        return losses[:, 1], checks.reshape(-1, len(COLUMNS))
    except (OSError, ValueError, IndexError) as error:
        raise TrainError(folder, f"holds no finished training: {str(error).splitlines()[0][:200]}") from error


def write_pictures(path: Path, samples: Samples) -> None:
    """Write a PNG of targets above generated images, one column per stroke. Raises OSError."""
    from matplotlib.figure import Figure

    count = len(samples.inputs)
    figure = Figure(figsize=(1.6 * count, 3.8))
    figure.subplots_adjust(0.04, 0.01, 0.99, 0.88, 0.04, 0.04)  # a computed layout takes seconds for so many axes
    axes: Any = figure.subplots(2, count, squeeze=False)
    for k in range(count):
        values = [f"{name} {float(value):.3g}" for name, value in zip(INPUTS, samples.inputs[k], strict=True)]
        axes[0, k].set_title("\n".join(values), fontsize=6)
        for row, image in enumerate((samples.targets[k], samples.drawn[k])):
            axes[row, k].imshow(1 - image, cmap="gray", vmin=0, vmax=1)
            axes[row, k].set(xticks=[], yticks=[])
    axes[0, 0].set_ylabel("target")
    axes[1, 0].set_ylabel("generator")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100)
    write_whole(path, out.getvalue())


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
        f"- Inputs: H from {target.depth_mm[0]:g} to {target.depth_mm[1]:g} mm, alpha from {target.tilt_deg[0]:g} to "
        f"{target.tilt_deg[1]:g} deg",
        f"- Network: {config.weight_count:,} weights, {config.layers.model_dump()}",
        f"- Training: {report.get('steps')} steps of {config.batch}, seed {config.seed}, {report.get('end')}; "
        f"{report.get('cpu_s')} s of CPU time since the last start; torch {report.get('torch')}",
    ]
    images = "captured strokes that were held out" if tuning else "exact images that it was not trained on"
    lines += ["", f"On {report.get('images')} {images} ({report.get('ssim_settings')}):", "", "| | |", "|---|---|"]
    for label, key, form in NUMBERS:
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
