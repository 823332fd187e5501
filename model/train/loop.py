"""Algorithm 1 of the paper: sample H and alpha, draw the stroke, compare, update, until convergence or G steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from brushloop.model.generator.network import Generator, squared_error
from brushloop.model.train.checkpoint import State, put_weights
from brushloop.model.train.config import TrainConfig
from brushloop.model.train.data import Images, batches
from brushloop.model.train.errors import BlankOutput, Diverged, TrainingStopped

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
    """Shows the progress of a training."""

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
    stopping: Callable[[], bool] = lambda: False,
) -> State:
    """Train from `state` to the end; returns the last state, which is also passed to `watcher.checkpoint`.

    Sets torch's threads to `config.threads`. The result has the same bits however often the training is interrupted
    and resumed. Raises BlankOutput, Diverged, or TrainingStopped when `stopping` returns true.
    """
    torch.set_num_threads(config.threads)
    network = config.build_network()
    put_weights(network, state.weights)
    network.to(config.device)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    _put_moments(optimiser, network, state)
    run = _Run(config, network, optimiser, sets, watcher, state.losses.tolist(), state.validations.tolist())
    with closing(batches(config, sets[0], state.step)) as drawn:
        return _steps(run, drawn, state.step, stopping)


def _steps(run: _Run, drawn: Iterator[tuple[Tensor, Tensor]], step: int, stopping: Callable[[], bool]) -> State:
    """Make the steps that are left, and what falls due between them."""
    config, watcher, saved = run.config, run.watcher, step
    while step < config.steps and not converged(config, run.validations):
        stop = stopping()
        loss = run.step(step, *next(drawn))
        step += 1
        if not math.isfinite(loss):
            raise Diverged(step)
        watcher.stepped(step, loss)
        last = step == config.steps
        if last or step % config.validate_every == 0:
            run.validate(step)
        if last or step % config.picture_every == 0:
            run.show(step)
        if last or stop or step % config.checkpoint_every == 0 or converged(config, run.validations):
            saved = step
            watcher.checkpoint(run.state(step))
        if stop and not last:
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


def validate(network: Generator, images: Images, config: TrainConfig, step: int) -> Validation:
    """Compute means over the whole set."""
    sums = torch.zeros(5, dtype=torch.float64)
    with torch.no_grad():
        for numbers in torch.arange(len(images)).split(config.batch):
            inputs, target = images.pick(numbers)
            drawn = network(inputs.to(config.device)).cpu()
            a, b = drawn.flatten(1), target.flatten(1)
            ink, wanted = a > 0.5, b > 0.5
            iou = (ink & wanted).sum(-1) / (ink | wanted).sum(-1).clamp(min=1)
            cosine = torch.nn.functional.cosine_similarity(a, b)
            parts = ((a - b).square().mean(-1), iou, cosine, a.mean(-1), b.mean(-1))
            sums += torch.stack([part.double().sum() for part in parts])
    return Validation(step, *(sums / len(images)).tolist())


@dataclass(slots=True, eq=False)
class _Run:
    """State of a running training."""

    config: TrainConfig
    network: Generator
    optimiser: torch.optim.Adam
    sets: tuple[Images, Images]
    watcher: Watcher
    losses: list[float]
    validations: list[list[float]]
    blanks: int = 0

    def step(self, step: int, inputs: Tensor, target: Tensor) -> float:
        """Make one update; return Eq. 6 over the batch."""
        config = self.config
        inputs, target = inputs.to(config.device), target.to(config.device)
        for options in self.optimiser.param_groups:
            options["lr"] = learning_rate(config, step)
        loss = squared_error(self.network.field(inputs), target, config.ink_weight) / target.numel()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        value = float(loss.detach())
        if math.isfinite(value):  # keep the last good weights
            self.optimiser.step()
            self.losses.append(value)
        return value

    def validate(self, step: int) -> None:
        """Validate, and raise BlankOutput if the output was blank too often."""
        found = validate(self.network, self.sets[1], self.config, step)
        self.validations.append([float(step), found.mse, found.iou, found.csim])
        self.watcher.validated(found)
        self.blanks = self.blanks + 1 if found.blank else 0
        if self.blanks >= self.config.blank_after:
            raise BlankOutput(step, found.ink_share, found.target_share)

    def show(self, step: int) -> None:
        """Hand eight validation strokes to the watcher."""
        inputs, target = self.sets[1].pick(torch.arange(min(8, len(self.sets[1]))))
        with torch.no_grad():
            drawn = self.network(inputs.to(self.config.device)).cpu()
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
