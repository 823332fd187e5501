"""Captured strokes to fine-tune on, as one safetensors file that whoever has them writes.

Tensors: `images` (n, N, N) uint8 (255 is ink) or float32 in [0, 1], and one (n,) float32 or float64 of each of the
generator's inputs, by name, in its unit. Metadata: `format` (FORMAT), `px_mm`, `placement`, and `source`, what kind of
ink it is. Scale and placement must be the generator's own, else its pixels would mean something else.
"""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from model.train.checkpoint import read_tensors, write_whole
from model.train.config import TrainConfig
from model.train.data import Kept
from model.train.errors import TrainError

FORMAT = "brushloop-captures-1"
MAX_BYTES = 2**30


def save_captures(
    path: Path, inputs: dict[str, Tensor], images: Tensor, px_mm: float, placement: str, source: str
) -> None:
    """Write captures, `inputs` each (n,) by name, `images` (n, N, N) in [0, 1]; a source as `loopback rig`."""
    pixels = (images.clamp(0, 1) * 255).round().to(torch.uint8)
    tensors = {"images": pixels.contiguous()} | {name: value.float().contiguous() for name, value in inputs.items()}
    metadata = {"format": FORMAT, "px_mm": repr(px_mm), "placement": placement, "source": source}
    write_whole(path, save(tensors, metadata))


def load_captures(path: Path, config: TrainConfig) -> tuple[Kept, str]:
    """Captures for a generator of this configuration, and their source. Raises TrainError for any that do not fit."""
    metadata, tensors = read_tensors(path, MAX_BYTES)
    if metadata.get("format") != FORMAT:
        raise TrainError(path, f"format is {metadata.get('format', 'missing')[:60]!r}, expected {FORMAT!r}")
    placement, size = config.target.placement, config.target.size_px
    if metadata.get("placement") != placement:
        raise TrainError(
            path, f"placement is {metadata.get('placement', 'missing')[:40]!r}, the generator's {placement}"
        )
    if metadata.get("px_mm") != repr(config.target.px_mm):
        raise TrainError(
            path, f"px_mm is {metadata.get('px_mm', 'missing')[:40]}, the generator's {config.target.px_mm}"
        )
    images = tensors.pop("images", None)
    if images is None or images.ndim != 3 or images.shape[1:] != (size, size) or len(images) < 2:
        raise TrainError(path, f"images must be (n, {size}, {size}) with n of at least 2")
    if images.dtype == torch.uint8:
        images = images.float() / 255
    if images.dtype != torch.float32 or not ((images >= 0) & (images <= 1)).all():
        raise TrainError(path, "images must be uint8, or float32 from 0 to 1")
    columns: list[Tensor] = []
    for spec in config.build_target().inputs:
        value = tensors.pop(spec.name, None)
        if value is None or value.shape != (len(images),) or not value.is_floating_point():
            raise TrainError(path, f"{spec.name} must be {len(images)} floating-point numbers")
        bad = ~((value >= spec.low) & (value <= spec.high))
        if bad.any():
            raise TrainError(path, f"{spec.name} = {float(value[bad][0]):g} is outside [{spec.low:g}, {spec.high:g}]")
        columns.append(value.float())
    for name in sorted(tensors):
        raise TrainError(path, f"{name[:60]!r} is no input of the generator")
    return Kept(torch.stack(columns, dim=-1), images), metadata.get("source", "not stated")[:200].replace("\n", " ")
