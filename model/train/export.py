"""Exports of a generator (ONNX, torch.export), each checked against the network, and of the fitted field basis."""

from __future__ import annotations

import importlib.util
import json
import logging
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from model.generator.basis import fit_basis
from model.generator.metrics import quality
from model.generator.network import Generator
from model.train.checkpoint import load_weights, write_whole
from model.train.config import TrainConfig, preset
from model.train.data import exact_sets
from model.train.errors import MissingExtra, TrainError
from model.train.report import write_card

TOLERANCE = 1e-4
"""Greatest allowed difference of any pixel in a check; reordered float32 sums differ by less."""
_CHECKED = (1, 5, 64)


def export(path: Path, form: str) -> tuple[Path, float]:
    """Write `<stem>.onnx` or `<stem>.pt2`, and a card, next to a generator; return its path and the largest difference.

    The exported file accepts any batch size; inputs are in the units of the card. Raises TrainError for an unknown form
    or if the exported file, which is then removed, draws something else, and MissingExtra without onnx.
    """
    writers = {"onnx": _onnx, "pt2": _program}
    if form not in writers:
        raise TrainError(path, f"form {form!r} is not known; known: {', '.join(writers)}")
    config, network, report = load_weights(path)
    out = path.with_suffix(f".{form}")
    part = out.with_name(f"{out.stem}.part.{form}")
    try:
        draw = writers[form](network, _samples(config, 3), part)
        worst = 0.0
        for count in _CHECKED:
            inputs = _samples(config, count)
            with torch.no_grad():
                worst = max(worst, float((network(inputs) - draw(inputs)).abs().max()))
        if not worst <= TOLERANCE:
            raise TrainError(out, f"draws pixels {worst:g} away from the network; at most {TOLERANCE:g}")
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    batches = ", ".join(map(str, _CHECKED))
    write_card(out, config, report, (f"Checked against the network in batches of {batches}: at most {worst:.1e} off.",))
    return out, worst


def _samples(config: TrainConfig, count: int) -> Tensor:
    """Inputs spread over the trained ranges, both ends included, (count, P)."""
    low = torch.tensor([spec.low for spec in config.build_target().inputs])
    high = torch.tensor([spec.high for spec in config.build_target().inputs])
    share = torch.linspace(0, 1, count).unsqueeze(-1)
    return low + (high - low) * (share * torch.arange(1, len(low) + 1) % 1.0001).clamp(max=1)


def _program(network: Generator, inputs: Tensor, path: Path) -> Any:
    """Export with torch.export: the traced network with its weights; return it as read back."""
    exported = torch.export.export(network, (inputs,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    with warnings.catch_warnings():
        # Strided weights are views of one storage, all of them on the CPU.
        warnings.filterwarnings("ignore", "No complete tensor found", UserWarning)
        torch.export.save(exported, path)
    return torch.export.load(path).module()


def _onnx(network: Generator, inputs: Tensor, path: Path) -> Any:
    """Export to ONNX; return the exported network, run by onnxruntime."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtra(package, "export")
    import onnxruntime

    with warnings.catch_warnings(), _quiet("torch.onnx._internal.exporter._registration"):
        warnings.filterwarnings("ignore", ".*LeafSpec.* is deprecated", FutureWarning)
        program = torch.onnx.export(
            network,
            (inputs,),
            dynamo=True,
            input_names=["inputs"],
            output_names=["coverage"],
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            verbose=False,
        )
    untyped: Any = program
    untyped.save(str(path), external_data=False)
    session: Any = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return lambda values: torch.from_numpy(session.run(None, {"inputs": values.numpy()})[0])


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Limit a logger to errors: without torchvision, torch logs each of its operators that it skips."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def fit_and_compare(target: str, images: int, out: Path | None) -> str:
    """Fit the field basis; return a sentence with the figures. Raises TrainError unless the target has two inputs."""
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
