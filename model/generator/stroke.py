"""A trained generator as a stroke model: its file, its images in numpy, and the outlines traced from them.

Only training needs torch (`model.generator.train` has the same network).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from brushloop.model.ccdbsm import Brush
from brushloop.model.generator import SHIPPED_GENERATOR, TrainError
from brushloop.model.generator.config import INPUTS, MAX_WEIGHTS, Target, TrainConfig, checked
from brushloop.model.outline import Array, Outline, as_batch
from brushloop.model.strokes import StrokeModel, stroke_model, stroke_models

Singles = NDArray[np.float32]
FORMAT = "brushloop-generator-2"
SHIPPED = "ccd-bsmg"
"""Name of the generator that comes with brushloop."""
MAX_CONFIG_CHARS = 64 * 1024


@dataclass(frozen=True, slots=True, eq=False)
class GeneratorFile:
    """The content of a `generator.safetensors`."""

    config: TrainConfig
    """What it was trained on, and how."""
    weights: dict[str, Singles]
    report: dict[str, Any]
    """How its images compare with exact ones: plain numbers and strings."""

    def images(self, inputs: Array) -> Singles:
        """The network's images of (N, 2) inputs in its placement and scale, (N, size_px, size_px) in [0, 1]."""
        target, layers, weights = self.config.target, self.config.layers, self.weights
        low, high = np.transpose([getattr(target, name) for name in INPUTS]).astype(np.float32)
        unit = 2 * (np.asarray(inputs, np.float32) - low) / (high - low) - 1
        x = chebvander(unit, layers.degree)[..., 1:].reshape(len(unit), -1)
        for k in range(layers.depth + 1):
            x = x @ weights[f"fully_connected.{2 * k}.weight"].T + weights[f"fully_connected.{2 * k}.bias"]
            if k < layers.depth:
                x = x / (1 + np.exp(-x))  # SiLU
        side, scale = layers.side, target.size_px // layers.side
        padded = np.pad(x.reshape(-1, layers.channels, side, side), ((0, 0), (0, 0), (1, 1), (1, 1)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(2, 3))
        map_ = np.tensordot(windows, weights["convolution.0.weight"], axes=([1, 4, 5], [1, 2, 3]))
        map_ = (map_ + weights["convolution.0.bias"]).reshape(-1, side, side, scale, scale)
        field = map_.transpose(0, 1, 3, 2, 4).reshape(-1, target.size_px, target.size_px)  # pixel shuffle
        return np.clip(field + np.float32(0.5), 0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorModel(StrokeModel):
    """A stroke model that a trained generator draws.

    Its outlines are traced at half coverage between pixel centres, so a tip ends where the stroke is half a pixel wide.
    """

    file: GeneratorFile

    @property
    def target(self) -> Target:
        """What the generator was trained to draw."""
        return self.file.config.target


def load_generator(path: Path | str, brush: Brush | None = None) -> GeneratorModel:
    """Load `generator.safetensors` as a stroke model: the paper's CCD-BSMG for CCD-BSM, else `<model>-generator`.

    It is `fitted` if it was tuned on captures, or its brush was fitted to some. Raises TrainError for a file that
    cannot be used, and if it was trained for another brush than this.
    """
    file = read_generator(Path(path))
    target, is_tuned = file.config.target, file.config.tuning is not None
    if brush is not None:
        for name in ("radius_mm", "length_mm"):
            trained, wanted = getattr(target, name), float(getattr(brush, name))
            if wanted != trained:
                raise TrainError(path, f"was trained for a brush with {name} = {trained:g}, not {wanted:g}")
    learned = target.stroke_model
    paper = learned.name == "ccd-bsm"
    tuned = ", then tuned on captured strokes" if is_tuned else ""

    def profile(depth_mm: Array, tilt_deg: Array) -> Outline:
        inputs = np.stack(as_batch(depth_mm, tilt_deg), axis=-1)
        target.check(inputs)
        return traced(file.images(inputs), target.origin_mm(inputs), target.px_mm)

    return GeneratorModel(
        name="ccd-bsmg" if paper else f"{learned.name}-generator",
        label="CCD-BSMG" if paper else f"{learned.label} generator",
        definition=f"A network trained on exact images of {learned.label}{tuned}; its outline is traced at half "
        "coverage.",
        profile=profile,
        fitted=is_tuned or target.fitted_brush,
        file=file,
    )


def models() -> tuple[str, ...]:
    """Names of the stroke models of any brush, and of the generator that comes with brushloop."""
    return (*stroke_models(Brush()), SHIPPED)


def named_model(name: str, brush: Brush) -> StrokeModel:
    """The model of that name for one brush. Raises `UnknownModelError`, and `TrainError` as `load_generator` does."""
    return load_generator(SHIPPED_GENERATOR, brush) if name == SHIPPED else stroke_model(name, brush)


def traced(images: Singles, origin_mm: Array, px_mm: float) -> Outline:
    """The longest contour at half coverage of each image, (B, N, N) and (B, 2), as straight arcs in mm.

    Raises ValueError for an image without ink.
    """
    import skimage.measure

    untyped: Any = skimage.measure
    polygons: list[NDArray[np.float64]] = []
    for image, origin in zip(images.astype(np.float64), origin_mm, strict=True):
        contours = untyped.find_contours(np.pad(image, 1), 0.5)
        if not contours:
            raise ValueError("the generator draws no ink for these parameters")
        rows, columns = max(contours, key=len)[:-1].T - 0.5  # a pixel's centre is at + 1/2; the padding shifts by 1
        x, y = columns * px_mm - float(origin[0]), float(origin[1]) - rows * px_mm
        if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):
            x, y = x[::-1], y[::-1]
        polygons.append(np.stack((x, y), axis=-1))
    most = max(map(len, polygons))
    # Zero-length arcs at the end give all outlines the same number of arcs.
    ends = np.stack([np.concatenate((p, np.repeat(p[:1], most + 1 - len(p), axis=0))) for p in polygons])
    start, end = ends[:, :-1], ends[:, 1:]
    points = np.stack((start, 0.5 * (start + end), end), axis=2)
    return Outline(points, np.ones(points.shape[:2]))


def read_generator(path: Path) -> GeneratorFile:
    """Read a generator's file, which is not trusted: safetensors holds numbers and strings, never code.

    Its size is bounded before it is read, its configuration is validated, and its tensors must be finite and have the
    names, shapes and types of the network that the configuration describes. Raises TrainError.
    """
    metadata, tensors = read_tensors(path, 4 * MAX_WEIGHTS + 2**26)
    if metadata.get("format") != FORMAT:
        raise TrainError(path, f"format is {metadata.get('format', 'missing')[:60]!r}, not {FORMAT!r}")
    fields = _table(path, "config", metadata.get("config", ""))
    # What only steered the training of an earlier version says nothing about the images.
    config = checked(path, {name: value for name, value in fields.items() if name in TrainConfig.model_fields})
    wanted = config.layers.shapes(config.target.size_px)
    for name in sorted(wanted.keys() ^ tensors.keys()):
        raise TrainError(path, f"tensor {name[:100]!r} is {'missing' if name in wanted else 'not known'}")
    for name, shape in wanted.items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != np.float32:
            raise TrainError(path, f"{name} is {tensor.dtype} {tensor.shape}, expected float32 {shape}")
        if not np.isfinite(tensor).all():
            raise TrainError(path, f"{name} holds numbers that are not finite")
    return GeneratorFile(config, tensors, _table(path, "report", metadata.get("report", "")))


def read_tensors(path: Path, most_bytes: int) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Read metadata and arrays of a safetensors file of at most `most_bytes`. Raises TrainError."""
    try:
        size = path.stat().st_size
    except OSError as error:
        what = "no such file" if isinstance(error, FileNotFoundError) else str(error.strerror)
        raise TrainError(path, what) from error
    if not path.is_file():
        raise TrainError(path, "is not a file")
    if size > most_bytes:
        raise TrainError(path, f"holds {size:,} bytes; at most {most_bytes:,} are read")
    try:
        with safe_open(path, framework="np") as file:
            untyped: Any = file
            return dict(untyped.metadata() or {}), {name: untyped.get_tensor(name) for name in untyped.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError, TypeError) as error:
        raise TrainError(path, f"is not a safetensors file: {str(error).splitlines()[0][:200]}") from error


def _table(path: Path, name: str, text: str) -> dict[str, Any]:
    """The JSON object in a piece of metadata."""
    if len(text) > MAX_CONFIG_CHARS:
        raise TrainError(path, f"{name} is longer than {MAX_CONFIG_CHARS} characters")
    try:
        table = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise TrainError(path, f"{name} is not JSON") from error
    if not isinstance(table, dict):
        raise TrainError(path, f"{name} is not a table")
    return table
