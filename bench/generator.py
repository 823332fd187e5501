"""How close and how fast the generator is, beside a Learning-to-Paint-type network with equal images and time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from bench.harness import Result, interleave, machine
from bench.learning_to_paint import LearningToPaint
from brushloop.model.generator.metrics import Quality, quality
from brushloop.model.generator.network import Generator
from brushloop.model.train.checkpoint import State, put_weights
from brushloop.model.train.config import TrainConfig, preset
from brushloop.model.train.data import Exact, batch_numbers, batches, exact_sets
from brushloop.model.train.loop import Validation, learning_rate, new_state, train

BUDGET_S = 360
PEER_RATE = 1e-3
_TRIAL_STEPS = 15
_ROUNDS = 20
_DRAWN = 200
DRAWING_STEPS = 200
DRAWING_SHARE = 0.07
"""The share that drawing had of the training on one core before presses were drawn without an outline."""
_SHARE = 0.95  # of the budget: steps are counted out beforehand, and their cost wavers


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """CCD-BSMG of (H, alpha) compared with the peer; see `_compare`."""
    return _compare("press", "generator", n, seed)


def run_qbc(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """The same network on QBC strokes, 8 inputs (the paper's ablation), compared with the peer; see `_compare`."""
    return _compare("qbc", "generator-qbc", n, seed)


def run_drawing(*, n: int | None = None, seed: int = 0) -> Result:
    """The share of the training's CPU time in which its batches are drawn, over `n` steps (200) on one thread."""
    steps = DRAWING_STEPS if n is None else n
    if steps < 1:
        raise ValueError(f"n = {n}: at least one step is needed")
    quiet = {"picture_every": 10**9, "checkpoint_every": 10**9, "validate_every": 10**9}
    config = preset("press", seed=seed).model_copy(update=quiet | {"steps": steps})
    with _one_thread():
        training, validation = exact_sets(config)
        few = (training, Exact(validation.target, validation.inputs[:1]))
        state = new_state(config)
        began = time.process_time()
        train(config, state, few, _Quiet())
        whole_s = time.process_time() - began
        drawing_s = _drawing_s(config, training, steps)
    conditions = f"{steps} steps of {config.batch} images, {whole_s:.1f} CPU-s; {machine()}"
    return _drawn("generator", drawing_s / whole_s, seed, conditions)


def _drawn(name: str, share: float, seed: int, conditions: str) -> Result:
    peer = f"{DRAWING_SHARE:g} of it"
    return Result(
        f"{name}-drawing", share, "of the training's CPU time", peer, DRAWING_SHARE / share, 1, seed, conditions
    )


def _compare(target: str, name: str, n: int | None, seed: int) -> Sequence[Result]:
    """Train both for `n` seconds of this process' CPU time each (360 by default) and compare on 2,000 held-out images.

    Both run on one thread, see the same 20,000 images in the same batches of 64, and fall in learning rate along the
    same half cosine; how many steps fit is measured beforehand. MSE, IoU, CSIM and SSIM are means over the images;
    their ratio is the peer's shortfall over ours. `-drawing` is the share of our time in which the batches are drawn.
    `-forward` is images/s at batch 64, taking turns.
    """
    budget_s = BUDGET_S if n is None else n
    if budget_s < 1:
        raise ValueError(f"n = {n}: at least one second of CPU time is needed")
    config = preset(target, seed=seed)
    with _one_thread():
        training, validation = exact_sets(config)
        ours, ours_s, ours_steps = _train_ours(config, (training, validation), budget_s)
        peer, peer_s, peer_steps = _train_peer(config, training, budget_s)
        unit = ours.inputs
        draw_peer = lambda values: peer((unit(values) + 1) / 2)  # noqa: E731
        found, other = _quality(ours, validation), _quality(draw_peer, validation)
        batch = validation.inputs[: config.batch]
        with torch.no_grad():
            turns = interleave(lambda: ours(batch), lambda: draw_peer(batch), _ROUNDS)
            drawing_s = _drawing_s(config, training, ours_steps)
    ours_weights, peer_weights = (sum(part.numel() for part in net.parameters()) for net in (ours, peer))
    conditions = (
        f"{target}, {budget_s} s of CPU time each, one thread: ours {ours_weights:,} weights, "
        f"{ours_steps} steps, {ours_s:.0f} s; peer {peer_weights:,} weights, {peer_steps} steps, "
        f"{peer_s:.0f} s, "
        f"MSE {other.mse:.3g}, PSNR {other.psnr_db:.1f} dB, IoU {other.iou:.5f}, CSIM {other.csim:.5f}, "
        f"SSIM {other.ssim:.5f} (least {other.ssim_min:.5f}); {machine()}"
    )
    forward, peer_forward = turns.median_s
    rows = [
        ("mse", found.mse, "MSE", other.mse / found.mse),
        ("psnr", found.psnr_db, "dB", found.psnr_db / other.psnr_db),
        ("iou", 1 - found.iou, "1 - IoU", _shortfall(other.iou, found.iou)),
        ("csim", 1 - found.csim, "1 - CSIM", _shortfall(other.csim, found.csim)),
        ("ssim", 1 - found.ssim, "1 - SSIM", _shortfall(other.ssim, found.ssim)),
        ("ssim-least", 1 - found.ssim_min, "1 - SSIM", _shortfall(other.ssim_min, found.ssim_min)),
        ("forward", config.batch / forward, "images/s", peer_forward / forward),
    ]
    peer_name = "Learning-to-Paint-type network"
    results = [
        Result(f"{name}-{what}", value, kind, peer_name, ratio, found.images, seed, conditions)
        for what, value, kind, ratio in rows
    ]
    results[-1] = replace(results[-1], **turns.ratios())
    return [*results, _drawn(name, drawing_s / ours_s, seed, conditions)]


def _drawing_s(config: TrainConfig, training: Exact, steps: int) -> float:
    """The CPU seconds for drawing the batches of this many steps, measured on some of them."""
    some = min(steps, _DRAWN)
    began = time.process_time()
    for _ in batches(config.model_copy(update={"steps": some}), training, 0):
        pass
    return (time.process_time() - began) * steps / some


def _shortfall(peer: float, ours: float) -> float:
    """How much further the peer is from 1."""
    return (1 - peer) / (1 - ours) if ours < 1 else math.inf


def _quality(draw: Callable[[Tensor], Tensor], images: Exact) -> Quality:
    def pairs() -> Iterator[tuple[Tensor, Tensor]]:
        for numbers in torch.arange(len(images)).split(64):
            inputs, target = images.pick(numbers)
            with torch.no_grad():
                yield draw(inputs), target

    return quality(pairs())


@dataclass(slots=True)
class _Quiet:
    """Keeps nothing; the training loop's watcher."""

    def stepped(self, step: int, loss: float) -> None: ...

    def validated(self, validation: Validation) -> None: ...

    def pictures(self, step: int, inputs: Tensor, targets: Tensor, drawn: Tensor) -> None: ...

    def checkpoint(self, state: State) -> None: ...


def _train_ours(config: TrainConfig, sets: tuple[Exact, Exact], budget_s: float) -> tuple[Generator, float, int]:
    """The product's own loop, with as many steps as fit; validations and all copies of the state count as well."""
    quiet = {"picture_every": 10**9, "checkpoint_every": 10**9, "validate_every": 10**9}
    trial = config.model_copy(update=quiet | {"steps": _TRIAL_STEPS})
    few = (sets[0], Exact(sets[1].target, sets[1].inputs[:1]))
    state = train(trial, new_state(trial), few, _Quiet())
    began = time.process_time()
    train(trial, State(state.weights, state.moments), few, _Quiet())
    steps = max(1, int(_SHARE * budget_s * _TRIAL_STEPS / (time.process_time() - began)))
    whole = config.model_copy(update=quiet | {"steps": steps})
    began = time.process_time()
    state = train(whole, new_state(whole), sets, _Quiet())
    used_s = time.process_time() - began
    network = whole.build_network().eval()
    put_weights(network, state.weights)
    return network, used_s, steps


def _train_peer(config: TrainConfig, training: Exact, budget_s: float) -> tuple[LearningToPaint, float, int]:
    """The peer on the same batches with plain MSE, as its authors train it."""
    torch.manual_seed(config.seed)
    network = LearningToPaint(len(training.target.inputs))
    unit = config.build_network().inputs
    optimiser = torch.optim.Adam(network.parameters(), lr=PEER_RATE, fused=True)

    def steps_of(count: int, whole: TrainConfig) -> float:
        began = time.process_time()
        for step in range(count):
            inputs, target = training.pick(batch_numbers(len(training), config.batch, config.seed, step))
            for options in optimiser.param_groups:
                options["lr"] = learning_rate(whole, step)
            optimiser.zero_grad(set_to_none=True)
            nn.functional.mse_loss(network((unit(inputs) + 1) / 2), target).backward()
            optimiser.step()
        return time.process_time() - began

    before = {name: value.clone() for name, value in network.state_dict().items()}
    trial = config.model_copy(update={"steps": _TRIAL_STEPS, "learning_rate": PEER_RATE})
    steps_of(3, trial)
    steps = max(1, int(_SHARE * budget_s * _TRIAL_STEPS / steps_of(_TRIAL_STEPS, trial)))
    network.load_state_dict(before)
    optimiser.state.clear()
    used_s = steps_of(steps, config.model_copy(update={"steps": steps, "learning_rate": PEER_RATE}))
    return network.eval(), used_s, steps


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hold torch to one thread, and restore what was set before."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
