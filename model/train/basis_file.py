"""The field basis from the command line: fit it, compare it with exact images, and keep it."""

from __future__ import annotations

import json
import time
from pathlib import Path

import torch
from safetensors.torch import save

from model.generator.basis import fit_basis
from model.generator.metrics import quality
from model.train.checkpoint import write_whole
from model.train.config import preset
from model.train.data import exact_sets
from model.train.errors import TrainError


def fit_and_compare(target: str, images: int, out: Path | None) -> str:
    """A sentence with the figures. Raises TrainError for a target that has not two inputs."""
    config = preset(target, validation_images=images, training_images=1)
    strokes = config.build_target()
    if len(strokes.inputs) != 2:
        raise TrainError(target, f"has {len(strokes.inputs)} inputs; the field basis is for press and anchored")
    torch.set_num_threads(config.threads)
    began = time.process_time()
    basis = fit_basis(strokes)
    cpu_s = time.process_time() - began
    exact = exact_sets(config)[1]
    with torch.no_grad():
        parts = (exact.pick(numbers) for numbers in torch.arange(len(exact)).split(config.batch))
        found = quality((basis(inputs), image) for inputs, image in parts)
    if out is not None:
        metadata = {"format": "brushloop-field-basis-1", "degrees": json.dumps(basis.degrees)}
        metadata["target"] = config.target.model_dump_json()
        write_whole(out, save({"coefficients": basis.coefficients.contiguous()}, metadata))
    return (
        f"Field basis (a least-squares interpolator, no network), {basis.coefficients.numel():,} numbers, "
        f"fitted in {cpu_s:.1f} s of CPU time: MSE {found.mse:.3g}, PSNR {found.psnr_db:.1f} dB, IoU {found.iou:.5f}, "
        f"CSIM {found.csim:.5f} over {found.images} images"
    )
