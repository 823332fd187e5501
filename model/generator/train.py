"""The neural generator in torch, and Algorithm 1 of the paper that trains it in one folder.

The network is fully connected layers, then convolution with pixel shuffle (the paper's section III-B, which gives no
layer sizes). It outputs not the coverage itself but a field: approximately the signed distance to the stroke's boundary
in pixels, positive inside, with coverage = clamp(1/2 + field, 0, 1). The field changes smoothly with depth and tilt
where coverage jumps, and pixels far from the boundary are exactly 0 or 1, so the network spends no capacity on them.
`model.generator.stroke` computes the same images in numpy.

The algorithm samples H and alpha, draws the stroke, compares and updates, until convergence. A folder holds
`checkpoint.pt` during and after training, `generator.safetensors` with its card `generator.md` at the end, and what
`model.generator.card` writes. The same training started again resumes at the last checkpoint.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import Tensor, nn

from brushloop.model.generator import TrainError, TrainingStopped
from brushloop.model.generator.card import (
    Samples,
    likeness,
    report_of,
    save_samples,
    write_card,
    write_curves,
    write_pictures,
)
from brushloop.model.generator.config import INPUTS, Layers, Target, TrainConfig, differences
from brushloop.model.generator.data import (
    Images,
    TuningFiles,
    batch_numbers,
    exact_sets,
    load_captures,
    sha256,
    split,
    write_whole,
)
from brushloop.model.generator.stroke import FORMAT, read_generator

Progress = Callable[[int, float, float], None]
"""Called after each step with its number, Eq. 6 of its batch, and the MSE of the last validation (NaN before one)."""
BLANK_SHARE = 0.05
"""Output is blank if its ink, or its paper, is less than this share of the targets' ink or paper."""
SHOWN = 8
"""Validation strokes in a picture."""
MOST_SAMPLES = 12
_GAIN = 0.99


class Generator(nn.Module):
    """Maps (B, 2) depths in mm and tilts in deg to (B, size_px, size_px) coverage in [0, 1]."""

    low: Tensor
    high: Tensor

    def __init__(self, target: Target, layers: Layers) -> None:
        super().__init__()
        self.layers = layers
        # Buffers, so that the ranges move with the network to a device.
        ranges = torch.tensor([getattr(target, name) for name in INPUTS])
        self.register_buffer("low", ranges[:, 0], persistent=False)
        self.register_buffer("high", ranges[:, 1], persistent=False)
        fully: list[nn.Module] = []
        size = layers.degree * len(INPUTS)
        for _ in range(layers.depth):
            fully += [nn.Linear(size, layers.width), nn.SiLU()]
            size = layers.width
        fully.append(nn.Linear(size, layers.channels * layers.side**2))
        self.fully_connected = nn.Sequential(*fully)
        upscale = target.size_px // layers.side
        convolution = nn.Conv2d(layers.channels, upscale**2, 3, padding=1)
        self.convolution = nn.Sequential(convolution, nn.PixelShuffle(upscale))
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]

    def field(self, values: Tensor) -> Tensor:
        """The field, approximately the signed distance in pixels, (B, 2) -> (B, size_px, size_px).

        Values outside the ranges are extrapolated by the polynomials.
        """
        layers = self.layers
        unit = 2 * (values - self.low) / (self.high - self.low) - 1
        terms = [torch.ones_like(unit), unit]
        for _ in range(layers.degree - 1):  # Chebyshev polynomials: T_k+1 = 2 x T_k - T_k-1
            terms.append(2 * unit * terms[-1] - terms[-2])
        inputs = torch.stack(terms[1 : layers.degree + 1], dim=-1).flatten(1)
        map_ = self.fully_connected(inputs).unflatten(1, (layers.channels, layers.side, layers.side))
        return self.convolution(map_).squeeze(1)

    def forward(self, values: Tensor) -> Tensor:
        """Coverage, clamp(1/2 + field, 0, 1); differentiable in the values."""
        return covered(self.field(values))


def covered(field: Tensor) -> Tensor:
    """The coverage of a field, any shape."""
    return (field + 0.5).clamp(0, 1)


class _WeightedError(torch.autograd.Function):
    """Sum of w (clamp(1/2 + field) - target)^2, with a gradient that also passes where the clamp is flat.

    A field that is far on the wrong side of the boundary has no gradient through clamp(1/2 + field). The gradient used
    here is the residual w (clamp(1/2 + field) - target): that of the convex function whose derivative is the clamp,
    as cross-entropy relates to the sigmoid. It is zero exactly where Eq. 6 is, and equals the gradient of Eq. 6
    between 0 and 1. One pass over the images in each direction.
    """

    @staticmethod
    def forward(ctx: Any, field: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        error = field.add(0.5).clamp_(0, 1).sub_(target)
        weighted = error if weights is None else error * weights
        ctx.save_for_backward(weighted)
        return (error * weighted).sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (weighted,) = ctx.saved_tensors
        return weighted * (2 * grad), None, None


def squared_error(field: Tensor, target: Tensor, ink_weight: float = 1.0) -> Tensor:
    """Eq. 6 of the paper: the sum over all pixels of w (coverage - target)^2, w = 1 + (ink_weight - 1) target.

    `field` and `target` are (B, N, N). Divide by the number of pixels of the whole batch for Eq. 6.
    """
    weights = None if ink_weight == 1.0 else 1 + (ink_weight - 1) * target
    total = _WeightedError.apply(field, target, weights)
    assert isinstance(total, Tensor)
    return total


def run_training(
    config: TrainConfig,
    folder: Path,
    progress: Progress,
    stopping: Callable[[], bool] = lambda: False,
    tuning: TuningFiles | None = None,
) -> Path:
    """Train to the end, from the folder's checkpoint if it has one; return the generator's path.

    Sets torch's threads to `config.threads`. Raises TrainError for "cuda" without a GPU and if the folder holds another
    training or is in use; TrainingStopped if the output stays blank, the loss is no longer a number, or `stopping`
    returns true.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise TrainError("device", "cuda was asked for, but this machine has no usable GPU")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "generator.safetensors"
    try:
        with FileLock(folder / ".lock", timeout=0):
            torch.set_num_threads(config.threads)
            run = _Training(config, folder, progress, _sets(config, tuning))
            run.start(tuning)
            if run.ended and path.exists():
                return path
            began = time.process_time()
            run.train(stopping)
            run.finish(path, time.process_time() - began)
    except Timeout as error:
        raise TrainError(folder, "another training writes here") from error
    return path


def _sets(config: TrainConfig, tuning: TuningFiles | None) -> tuple[Images, Images]:
    """Training and validation images."""
    if config.tuning is None:
        return exact_sets(config)
    if tuning is None:
        raise TrainError("captures", "this training learns from captures; name their file")
    if sha256(tuning.captures) != config.tuning.captures_sha256:
        raise TrainError(tuning.captures, "is not the file that this training learns from")
    captures, _ = load_captures(tuning.captures, config.target)
    return split(captures, config.seed, config.tuning.held_out)


def new_network(config: TrainConfig) -> Generator:
    """The network with the weights of the seed; the state of torch's random generator stays unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return Generator(config.target, config.layers)


def learning_rate(config: TrainConfig, step: int) -> float:
    """The rate of a step: rises linearly over the warm-up, then falls along half a cosine to the last step."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    return config.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * step / config.steps))


def converged(config: TrainConfig, errors: list[float]) -> bool:
    """Whether the validation errors so far meet the target or stopped improving."""
    if not errors:
        return False
    if errors[-1] <= config.target_mse:
        return True
    patience = config.patience
    if not patience or len(errors) <= patience:
        return False
    return min(errors[-patience:]) > _GAIN * min(errors[:-patience])


@dataclass(slots=True, eq=False)
class _Training:
    """A training after `step` steps, with Eq. 6 of every step and the validations so far."""

    config: TrainConfig
    folder: Path
    progress: Progress
    sets: tuple[Images, Images]
    step: int = 0
    losses: list[float] = field(default_factory=list[float])
    validations: list[tuple[int, float, float, float]] = field(default_factory=list[tuple[int, float, float, float]])
    """(step, MSE, IoU, CSIM)."""
    blanks: int = 0
    network: Generator = field(init=False)
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        self.network = new_network(self.config).to(self.config.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=self.config.learning_rate, fused=True)

    @property
    def ended(self) -> bool:
        """Whether all steps are done, or the training has converged."""
        return self.step == self.config.steps or converged(self.config, [row[1] for row in self.validations])

    def start(self, tuning: TuningFiles | None) -> None:
        """Continue from the folder's checkpoint, or begin with the weights of the generator to tune."""
        if self._checkpoint.exists():
            self._resume()
        elif tuning is not None:
            file = read_generator(tuning.start)
            same = file.config.model_copy(update={"target": self.config.target, "layers": self.config.layers})
            for difference in differences(file.config, same):
                raise TrainError(tuning.start, f"is another generator: {difference}")
            self.network.load_state_dict({name: torch.from_numpy(value) for name, value in file.weights.items()})

    def train(self, stopping: Callable[[], bool]) -> None:
        """Make the steps that are left, and what falls due between them."""
        config, saved = self.config, self.step
        while not self.ended:
            stop = stopping()
            self._update()
            last = self.step == config.steps
            if last or self.step % config.validate_every == 0:
                self._validate()
            if last or self.step % config.picture_every == 0:
                self._show()
            if stop or self.ended or self.step % config.checkpoint_every == 0:
                saved = self.step
                self._save()
            if stop and not last:
                raise TrainingStopped(saved, "stopped as requested; the same command resumes here")

    def _update(self) -> None:
        """Make one update by Eq. 6 over the step's batch."""
        config, images = self.config, self.sets[0]
        inputs, target = images.pick(batch_numbers(len(images), config.batch, config.seed, self.step))
        values, wanted = (torch.from_numpy(part).to(config.device) for part in (inputs, target))
        for options in self.optimiser.param_groups:
            options["lr"] = learning_rate(config, self.step)
        loss = squared_error(self.network.field(values), wanted, config.ink_weight) / wanted.numel()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        value = float(loss.detach())
        self.step += 1
        if not math.isfinite(value):  # the last good weights stay in the checkpoint
            raise TrainingStopped(self.step, "the loss is no longer a number; train again with a smaller learning_rate")
        self.optimiser.step()
        self.losses.append(value)
        self.progress(self.step, value, self.validations[-1][1] if self.validations else math.nan)

    def _validate(self) -> None:
        """Compute means over the validation set; raise TrainingStopped if the output was blank too often."""
        sums = np.zeros(5)
        for drawn, target in self._drawn(self.sets[1]):
            shares = (images.mean((1, 2)).sum() for images in (drawn, target))
            sums += [*likeness(drawn, target).sum(0), *shares]
        mse, iou, csim, ink, wanted = (sums / len(self.sets[1])).tolist()
        self.validations.append((self.step, mse, iou, csim))
        is_blank = ink < BLANK_SHARE * wanted or 1 - ink < BLANK_SHARE * (1 - wanted)
        self.blanks = self.blanks + 1 if is_blank else 0
        if self.blanks >= self.config.blank_after:
            what = f"the generator draws {ink:.2%} ink where the targets hold {wanted:.2%}"
            advice = "train again in a new folder with a smaller learning_rate or a larger ink_weight"
            raise TrainingStopped(self.step, f"{what}; {advice}")

    def _drawn(self, images: Images) -> Any:
        """(drawn, target) batches of a set, each (n, N, N)."""
        for numbers in np.array_split(np.arange(len(images)), -(-len(images) // self.config.batch)):
            inputs, target = images.pick(numbers)
            yield self._images(inputs), target

    def _images(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.no_grad():
            return self.network(torch.from_numpy(inputs).to(self.config.device)).cpu().numpy()

    def _show(self) -> None:
        """Write the picture of Algorithm 1: some validation strokes, and what the network draws for them."""
        inputs, target = self.sets[1].pick(np.arange(min(SHOWN, len(self.sets[1]))))
        pictures = self.folder / "pictures"
        pictures.mkdir(exist_ok=True)
        write_pictures(pictures / f"step-{self.step:07d}.png", Samples(inputs, target, self._images(inputs)))

    @property
    def _checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    def _save(self) -> None:
        """Write the checkpoint: a reader, or the next process after a kill, sees the old or the new one."""
        out = io.BytesIO()
        state = {"config": self.config.model_dump_json(), "step": self.step, "losses": self.losses}
        state |= {"validations": self.validations, "network": self.network.state_dict()}
        torch.save(state | {"optimiser": self.optimiser.state_dict()}, out)
        write_whole(self._checkpoint, out.getvalue())

    def _resume(self) -> None:
        """Load the checkpoint, which is not trusted: `weights_only` unpickles tensors and plain values alone."""
        path = self._checkpoint
        try:
            state = torch.load(path, map_location=self.config.device, weights_only=True)
            before = TrainConfig.model_validate_json(state["config"])
            for difference in differences(before, self.config):
                raise TrainError(path, f"was trained with another configuration: {difference}; use a new folder")
            self.network.load_state_dict(state["network"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.step, self.losses, self.validations = state["step"], state["losses"], state["validations"]
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
            why = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            raise TrainError(path, f"is not a checkpoint of this training: {why}") from error

    def finish(self, path: Path, cpu_s: float) -> None:
        """Write the generator, its card, the curves and the samples."""
        config = self.config
        report = report_of(self._drawn(self.sets[1]))
        report |= {"steps": self.step, "end": "all steps done" if self.step == config.steps else "converged"}
        report |= {"cpu_s": round(cpu_s, 1), "torch": torch.__version__}
        state: dict[str, Tensor] = self.network.state_dict()
        weights = {name: np.ascontiguousarray(value.cpu().numpy()) for name, value in state.items()}
        metadata = {"format": FORMAT, "config": config.model_dump_json(), "report": json.dumps(report)}
        write_whole(path, save(weights, metadata))
        write_curves(self.folder, self.losses, self.validations)
        numbers = np.linspace(0, len(self.sets[1]) - 1, min(MOST_SAMPLES, len(self.sets[1]))).round().astype(int)
        inputs, targets = self.sets[1].pick(numbers)
        save_samples(self.folder, Samples(inputs, targets, self._images(inputs)))
        write_card(path, config, report)
