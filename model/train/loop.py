"""Algorithm 1 of the paper: sample H and alpha, draw the stroke, compare, update, until convergence or G steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from model.generator.network import Generator, squared_error
from model.train.checkpoint import State, put_weights
from model.train.config import TrainConfig
from model.train.data import Batch, Images, batches
from model.train.distributed import Group
from model.train.errors import BlankOutput, Diverged, TrainingStopped

BLANK_SHARE = 0.05
"""Output is blank if its ink, or its paper, is less than this share of the targets' ink or paper."""
_GAIN = 0.99


@dataclass(frozen=True, slots=True)
class Validation:
    """Means over the validation set after `step` steps; ink shares are of all pixels."""

    step: int
    mse: float
    iou: float
    csim: float
    ink_share: float
    target_share: float

    @property
    def blank(self) -> bool:
        """Whether the images hold almost no ink, or almost no paper."""
        paper, target_paper = 1 - self.ink_share, 1 - self.target_share
        return self.ink_share < BLANK_SHARE * self.target_share or paper < BLANK_SHARE * target_paper


class Progress(Protocol):
    """Shows the progress of a training, in the first process only."""

    def stepped(self, step: int, loss: float) -> None:
        """Called after a step."""
        ...

    def validated(self, validation: Validation) -> None:
        """Called after a validation."""
        ...


class Watcher(Progress, Protocol):
    """Also receives what a training writes."""

    def pictures(self, step: int, inputs: Tensor, targets: Tensor, drawn: Tensor) -> None:
        """Called every m steps with the targets and drawn images of some validation strokes."""
        ...

    def checkpoint(self, state: State) -> None:
        """Called with a state to save."""
        ...


def new_state(config: TrainConfig) -> State:
    """Make the state at step 0: the weights of the seed, and Adam without moments."""
    weights = {name: value.detach().clone() for name, value in config.build_network().named_parameters()}
    return State(weights, {name: (torch.zeros_like(v), torch.zeros_like(v)) for name, v in weights.items()})


def train(
    config: TrainConfig,
    state: State,
    sets: tuple[Images, Images],
    watcher: Watcher,
    group: Group | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> State:
    """Train from `state` to the end; returns the last state, which is also passed to `watcher.checkpoint`.

    Sets torch's threads to `config.threads`. A single process gives the same bits however often it is interrupted and
    resumed; several give the same sums per global batch up to rounding. Raises BlankOutput, Diverged, or
    TrainingStopped when `stopping` returns true in any process.
    """
    group = group or Group()
    torch.set_num_threads(config.threads)
    network = config.build_network()
    put_weights(network, state.weights)
    network.to(group.device)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    _put_moments(optimiser, network, state)
    run = _Run(config, network, optimiser, sets, watcher, group, state.losses.tolist(), state.validations.tolist())
    with closing(batches(config, sets[0], group, state.step)) as drawn:
        return _steps(run, drawn, state.step, stopping)


def _steps(run: _Run, drawn: Iterator[Batch], step: int, stopping: Callable[[], bool]) -> State:
    """Make the steps that are left, and what falls due between them."""
    config, group, watcher, saved = run.config, run.group, run.watcher, step
    while step < config.steps and not converged(config, run.validations):
        loss, stop = run.step(step, next(drawn), stopping())
        step += 1
        if not math.isfinite(loss):
            raise Diverged(step)
        if group.first:
            watcher.stepped(step, loss)
        last = step == config.steps
        if last or step % config.validate_every == 0:
            run.validate(step)
        if group.first and (last or step % config.picture_every == 0):
            run.show(step)
        if last or stop or step % config.checkpoint_every == 0 or converged(config, run.validations):
            saved = step
            if group.first:
                watcher.checkpoint(run.state(step))
        if stop and not last:
            group.wait()
            raise TrainingStopped(saved, "stopped as requested; the same command resumes here")
    return run.state(step)


def converged(config: TrainConfig, validations: list[list[float]]) -> bool:
    """Whether the validations so far, rows of `checkpoint.COLUMNS`, meet the target or stopped improving."""
    errors = [row[1] for row in validations]
    if not errors:
        return False
    if errors[-1] <= config.target_mse:
        return True
    patience = config.patience
    if not patience or len(errors) <= patience:
        return False
    return min(errors[-patience:]) > _GAIN * min(errors[:-patience])


def learning_rate(config: TrainConfig, step: int) -> float:
    """The rate of a step: rises linearly over the warm-up, then falls along half a cosine to the last step."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    return config.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * step / config.steps))


def validate(network: Generator, images: Images, group: Group, batch: int, step: int = 0) -> Validation:
    """Compute means over the whole set; each process evaluates its share."""
    sums = torch.zeros(5, dtype=torch.float64)
    with torch.no_grad():
        for numbers in group.share(torch.arange(len(images))).split(batch):
            inputs, target = images.pick(numbers)
            drawn = network(inputs.to(group.device)).cpu()
            a, b = drawn.flatten(1), target.flatten(1)
            ink, wanted = a > 0.5, b > 0.5
            iou = (ink & wanted).sum(-1) / (ink | wanted).sum(-1).clamp(min=1)
            cosine = torch.nn.functional.cosine_similarity(a, b)
            parts = ((a - b).square().mean(-1), iou, cosine, a.mean(-1), b.mean(-1))
            sums += torch.stack([part.double().sum() for part in parts])
    sums = group.add(sums.to(group.device)).cpu() / len(images)
    return Validation(step, *sums.tolist())


@dataclass(slots=True, eq=False)
class _Run:
    """State of a running training."""

    config: TrainConfig
    network: Generator
    optimiser: torch.optim.Adam
    sets: tuple[Images, Images]
    watcher: Watcher
    group: Group
    losses: list[float]
    validations: list[list[float]]
    blanks: int = 0

    def step(self, step: int, batch: Batch, stopping: bool) -> tuple[float, bool]:
        """Make one update; return Eq. 6 over the global batch and whether any process was asked to stop."""
        config = self.config
        inputs, target = (part.to(self.group.device) for part in (batch.inputs, batch.target))
        for options in self.optimiser.param_groups:
            options["lr"] = learning_rate(config, step)
        pixels = batch.count * config.target.size_px**2
        loss = squared_error(self.network.field(inputs), target, config.ink_weight) / pixels
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        total, stop = self._summed(loss.detach(), stopping)
        if math.isfinite(total):  # keep the last good weights
            self.optimiser.step()
            self.losses.append(total)
        return total, stop

    def _summed(self, loss: Tensor, stopping: bool) -> tuple[float, bool]:
        """Sum loss, requests to stop and gradients over the group, in one message."""
        if self.group.world == 1:
            return float(loss), stopping
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        flags = torch.stack((loss, torch.tensor(float(stopping), device=loss.device)))
        message = self.group.add(torch.cat([flags, *(gradient.flatten() for gradient in gradients)]))
        parts = message[2:].split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view(gradient.shape))
        return float(message[0]), bool(message[1] > 0)

    def validate(self, step: int) -> None:
        """Validate, and raise BlankOutput if the output was blank too often."""
        found = validate(self.network, self.sets[1], self.group, self.config.batch, step)
        self.validations.append([float(step), found.mse, found.iou, found.csim])
        if self.group.first:
            self.watcher.validated(found)
        self.blanks = self.blanks + 1 if found.blank else 0
        if self.blanks >= self.config.blank_after:
            raise BlankOutput(step, found.ink_share, found.target_share)

    def show(self, step: int) -> None:
        """Hand eight validation strokes to the watcher."""
        inputs, target = self.sets[1].pick(torch.arange(min(8, len(self.sets[1]))))
        with torch.no_grad():
            drawn = self.network(inputs.to(self.group.device)).cpu()
        self.watcher.pictures(step, inputs, target, drawn)

    def state(self, step: int) -> State:
        """A copy of everything that a resumed training needs."""
        weights = {name: value.detach().cpu().clone() for name, value in self.network.named_parameters()}
        moments: dict[str, tuple[Tensor, Tensor]] = {}
        for name, parameter in self.network.named_parameters():
            kept: dict[str, Any] = self.optimiser.state[parameter]
            moments[name] = (kept["exp_avg"].cpu().clone(), kept["exp_avg_sq"].cpu().clone())
        validations = torch.tensor(self.validations, dtype=torch.float64).reshape(-1, 4)
        return State(weights, moments, step, torch.tensor(self.losses), validations)


def _put_moments(optimiser: torch.optim.Adam, network: Generator, state: State) -> None:
    """Load the state's moments and step count into Adam."""
    for name, parameter in network.named_parameters():
        first, second = (torch.empty_like(parameter).copy_(part) for part in state.moments[name])
        count = torch.tensor(float(state.step), device=parameter.device)
        optimiser.state[parameter] = {"step": count, "exp_avg": first, "exp_avg_sq": second}
