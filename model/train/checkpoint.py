"""Checkpoints and finished generators on disk: safetensors only, checked before anything is built from them.

The files are not trusted. safetensors holds numbers and strings, never code. In addition, the size is bounded before
reading, the configuration is validated, and all tensors must be finite and have the names, shapes and types of the
network that the configuration describes.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from brushloop.model.brush import Brush
from brushloop.model.generator.network import Generator
from brushloop.model.generator.stroke import GeneratorModel, generator_model
from brushloop.model.train.config import MAX_BYTES, MAX_WEIGHTS, TrainConfig, checked
from brushloop.model.train.errors import TrainError

CHECKPOINT, GENERATOR = "brushloop-checkpoint-1", "brushloop-generator-1"
MAX_HEADER_BYTES = 4 * 1024 * 1024
"""Largest header of a safetensors file; it holds the names of the tensors, and the configuration."""
_MAX_FILE_BYTES = 3 * 4 * MAX_WEIGHTS + 2**26
COLUMNS = ("step", "mse", "iou", "csim")
"""Columns of the validation history."""


@dataclass(slots=True, eq=False)
class State:
    """A training after `step` steps: weights and Adam's moments by parameter name, and the history so far.

    `losses` (step,) is Eq. 6 of every step, `validations` (k, 4) the columns of COLUMNS.
    """

    weights: dict[str, Tensor]
    moments: dict[str, tuple[Tensor, Tensor]]
    step: int = 0
    losses: Tensor = field(default_factory=lambda: torch.zeros(0))
    validations: Tensor = field(default_factory=lambda: torch.zeros((0, len(COLUMNS)), dtype=torch.float64))


def save_checkpoint(path: Path, config: TrainConfig, state: State) -> None:
    """Write a checkpoint atomically: a reader, or the next process after a kill, sees the old or the new one."""
    tensors = {f"weights.{name}": value for name, value in state.weights.items()}
    for name, (first, second) in state.moments.items():
        tensors |= {f"adam.{name}.first": first, f"adam.{name}.second": second}
    tensors |= {"history.losses": state.losses, "history.validations": state.validations}
    _write(path, tensors, {"format": CHECKPOINT, "step": str(state.step), "config": config.model_dump_json()})


def load_checkpoint(path: Path) -> tuple[TrainConfig, State]:
    """Read a checkpoint. Raises TrainError for anything but a valid checkpoint."""
    config, metadata, tensors = _read(path, CHECKPOINT)
    step = _whole(path, metadata, "step", config.steps)
    names = {name: value.shape for name, value in _skeleton(config).named_parameters()}
    wanted = {f"weights.{name}": shape for name, shape in names.items()}
    wanted |= {f"adam.{name}.{part}": shape for name, shape in names.items() for part in ("first", "second")}
    losses, validations = tensors.pop("history.losses", None), tensors.pop("history.validations", None)
    _match(path, tensors, wanted)
    if losses is None or losses.shape != (step,) or losses.dtype != torch.float32:
        raise TrainError(path, f"history.losses is not {step} float32 numbers")
    if validations is None or validations.ndim != 2 or validations.shape[1] != len(COLUMNS):
        raise TrainError(path, f"history.validations does not have the columns {', '.join(COLUMNS)}")
    if validations.dtype != torch.float64 or len(validations) > step + 1:
        raise TrainError(path, "history.validations is too long or not float64")
    weights = {name: tensors[f"weights.{name}"] for name in names}
    moments = {name: (tensors[f"adam.{name}.first"], tensors[f"adam.{name}.second"]) for name in names}
    return config, State(weights, moments, step, losses, validations)


def save_generator(path: Path, config: TrainConfig, weights: dict[str, Tensor], report: dict[str, Any]) -> None:
    """Write a finished generator: weights, configuration, and a report of plain numbers and strings."""
    metadata = {"format": GENERATOR, "config": config.model_dump_json(), "report": json.dumps(report)}
    _write(path, {f"weights.{name}": value for name, value in weights.items()}, metadata)


def load_weights(path: Path) -> tuple[TrainConfig, Generator, dict[str, Any]]:
    """Load a finished generator as (configuration, network in eval mode, report). Raises TrainError."""
    config, metadata, tensors = _read(path, GENERATOR)
    network = config.build_network().eval()
    _match(path, tensors, {f"weights.{name}": value.shape for name, value in network.named_parameters()})
    put_weights(network, {name: tensors[f"weights.{name}"] for name, _ in network.named_parameters()})
    try:
        report = json.loads(metadata.get("report", "{}"))
    except (ValueError, RecursionError) as error:
        raise TrainError(path, "report is not JSON") from error
    if not isinstance(report, dict):
        raise TrainError(path, "report is not a table")
    return config, network, report


def load_generator(path: Path | str, brush: Brush | None = None) -> GeneratorModel:
    """Load `generator.safetensors` as a stroke model, for the brush it was trained with or for another.

    Raises TrainError for a file that cannot be used, and for another brush if R and L are not inputs of the generator.
    """
    config, network, _ = load_weights(Path(path))
    if brush is not None:
        size = {"radius_mm": float(brush.radius_mm), "length_mm": float(brush.length_mm)}
        for name, value in size.items():
            trained = getattr(config.target, name)
            if name not in config.target.ranges and value != trained:
                raise TrainError(path, f"was trained for a brush with {name} = {trained:g}, not {value:g}")
        fields = config.model_dump()
        config = checked(path, fields | {"target": fields["target"] | size})
    return generator_model(network, config.build_target(), fitted=config.tuning is not None)


def put_weights(network: Generator, weights: dict[str, Tensor]) -> None:
    """Copy weights by name into a network, keeping the network's layouts and devices."""
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(weights[name])


def sha256(path: Path) -> str:
    """SHA-256 of a file's content. Raises TrainError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise TrainError(path, error.strerror or "cannot be read") from error


def _write(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    data = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, metadata)
    write_whole(path, data)


def write_whole(path: Path, data: bytes) -> None:
    """Write a temporary file, flush it to disk and rename it: after a kill there is the old file or the new one."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def read_tensors(path: Path, most_bytes: int) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read metadata and tensors of a safetensors file of at most `most_bytes`. Raises TrainError."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise TrainError(
            path, "no such file" if isinstance(error, FileNotFoundError) else str(error.strerror)
        ) from error
    if not path.is_file():
        raise TrainError(path, "is not a file")
    if size > most_bytes:
        raise TrainError(path, f"holds {size:,} bytes; at most {most_bytes:,} are read")
    try:
        with path.open("rb") as opened:
            header = int.from_bytes(opened.read(8), "little")
        if header > MAX_HEADER_BYTES:
            raise ValueError(f"its header has {header:,} bytes; at most {MAX_HEADER_BYTES:,} are read")
        with safe_open(path, framework="pt") as file:  # pyright: ignore[reportUnknownVariableType]
            untyped: Any = file
            return dict(untyped.metadata() or {}), {name: untyped.get_tensor(name) for name in untyped.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise TrainError(path, f"is not a safetensors file: {str(error).splitlines()[0][:200]}") from error


def _read(path: Path, kind: str) -> tuple[TrainConfig, dict[str, str], dict[str, Tensor]]:
    metadata, tensors = read_tensors(path, _MAX_FILE_BYTES)
    if metadata.get("format") != kind:
        raise TrainError(path, f"format is {metadata.get('format', 'missing')[:60]!r}, expected {kind!r}")
    text = metadata.get("config", "")
    if len(text) > MAX_BYTES:
        raise TrainError(path, f"config is longer than {MAX_BYTES} characters")
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise TrainError(path, "config is not JSON") from error
    return checked(path, fields), metadata, tensors


def _skeleton(config: TrainConfig) -> Generator:
    """Make the network without values: names and shapes only."""
    inputs, layers = config.build_target().inputs, config.build_layers()
    with torch.device("meta"):
        return Generator(inputs, layers)


def _match(path: Path, tensors: dict[str, Tensor], wanted: dict[str, torch.Size]) -> None:
    """Raise TrainError unless names, shapes and types agree and every number is finite."""
    for name in sorted(wanted.keys() ^ tensors.keys()):
        raise TrainError(path, f"tensor {name[:100]!r} is {'missing' if name in wanted else 'not known'}")
    for name, shape in wanted.items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != torch.float32:
            raise TrainError(path, f"{name} is {tensor.dtype} {tuple(tensor.shape)}, expected float32 {tuple(shape)}")
        if not tensor.isfinite().all():
            raise TrainError(path, f"{name} holds numbers that are not finite")


def _whole(path: Path, metadata: dict[str, str], name: str, most: int) -> int:
    text = metadata.get(name, "")
    if not text.isascii() or not text.isdigit() or len(text) > 9 or int(text) > most:
        raise TrainError(path, f"{name} = {text[:40]!r} is not a number from 0 to {most}")
    return int(text)
