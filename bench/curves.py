"""One network on three kinds of stroke, CCD-BSM, Bezier and QBC: the paper's figures 9 and 12.

`python -m bench curves` measures; `python -m bench.curves PATH [--steps N] [--seed K]` draws the figures as well.
Exact images of models, no captures: how well a network of one size repeats each closed form, and nothing of ink.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.harness import Result, machine
from brushloop.model.generator.targets import PRESETS
from brushloop.model.train.checkpoint import State
from brushloop.model.train.config import LayerConfig, TrainConfig, preset
from brushloop.model.train.data import exact_sets
from brushloop.model.train.loop import Validation, new_state, train

STEPS = 1000
CHECKS = 25
"""Validations on the way."""
VALIDATION_IMAGES = 500
RATE = 3e-3
SAMPLES = 8
ROW_INCHES = 2.6
STROKES = {
    "press": "CCD-BSM: H, α",
    "all": "CCD-BSM: L, R, H, α, x0, y0",
    "bezier": "Bézier: tip, base, belly, shoulder",
    "qbc": "QBC: three points, two widths",
}
"""Target -> what is drawn, and its inputs: two and six for CCD-BSM, four, eight."""
COLOURS = {"press": "#0072B2", "all": "#56B4E9", "bezier": "#009E73", "qbc": "#D55E00"}
"""Okabe and Ito's."""


@dataclass(slots=True)
class Trained:
    """The curves of one training, and some validation strokes: what was wanted, and what it draws."""

    config: TrainConfig
    losses: list[float]
    checks: list[Validation]
    pairs: tuple[Tensor, Tensor]
    """(SAMPLES, 128, 128) each."""


@dataclass(slots=True)
class _Watcher:
    """Keeps what the figures show; the training loop's watcher."""

    checks: list[Validation] = field(default_factory=list[Validation])
    pairs: tuple[Tensor, Tensor] | None = None

    def stepped(self, step: int, loss: float) -> None: ...

    def validated(self, validation: Validation) -> None:
        self.checks.append(validation)

    def pictures(self, step: int, inputs: Tensor, targets: Tensor, drawn: Tensor) -> None:
        self.pairs = targets[:SAMPLES], drawn[:SAMPLES]

    def checkpoint(self, state: State) -> None: ...


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """The last validation loss (MSE over 500 held-out images) of each after `n` steps of 64 images, 1,000 by default.

    One network (that of `--target qbc`), one learning rate, one seed. ratio = the loss on CCD-BSM of (H, alpha) over
    this one: with more inputs there is more to learn, and no kind of stroke is better for it.
    """
    return results(trained(STEPS if n is None else n, seed), seed)


def trained(steps: int, seed: int) -> dict[str, Trained]:
    """Every target trained, by name. Raises ValueError for less than one step."""
    if steps < 1:
        raise ValueError(f"n = {steps}: at least one step is needed")
    before = torch.get_num_threads()
    try:
        return {name: _trained(name, steps, seed) for name in STROKES}
    finally:
        torch.set_num_threads(before)


def _trained(name: str, steps: int, seed: int) -> Trained:
    shared = PRESETS["qbc"].layers
    config = preset(
        name,
        layers={size: getattr(shared, size) for size in LayerConfig.model_fields},
        learning_rate=RATE,
        steps=steps,
        seed=seed,
        validation_images=VALIDATION_IMAGES,
        validate_every=max(1, steps // CHECKS),
        picture_every=steps,
        checkpoint_every=steps,
        blank_after=CHECKS,  # the curve is the finding, also where it begins with nothing drawn
    )
    watcher = _Watcher()
    state = train(config, new_state(config), exact_sets(config), watcher)
    assert watcher.pairs is not None, "the last step shows pictures"
    return Trained(config, state.losses.tolist(), watcher.checks, watcher.pairs)


def results(done: dict[str, Trained], seed: int) -> list[Result]:
    """A line for each."""
    peer = done["press"].checks[-1].mse
    made: list[Result] = []
    for name, one in done.items():
        last, target = one.checks[-1], one.config.target
        conditions = (
            f"{STROKES[name]} ({len(target.ranges)} inputs, {target.px_mm:g} mm a pixel), {one.config.steps} steps of "
            f"{one.config.batch} images, {one.config.weight_count():,} weights, one thread: IoU {last.iou:.4f}, CSIM "
            f"{last.csim:.5f}, ink {last.target_share:.1%} of the image; exact images, no captures; {machine()}"
        )
        ratio = peer / last.mse if last.mse else float("inf")
        made.append(
            Result(
                f"curves: {name}",
                last.mse,
                "MSE",
                "the same on CCD-BSM (H, α)",
                ratio,
                one.config.steps,
                seed,
                conditions,
            )
        )
    return made


def draw(done: dict[str, Trained], path: Path) -> None:
    """Figure 9 above (training and validation loss), figure 12 below (targets, and what each network draws)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.0 + ROW_INCHES * len(done)), dpi=100, layout="constrained")
    untyped: Any = figure
    above, below = untyped.subfigures(2, 1, height_ratios=(4.0, ROW_INCHES * len(done)))
    left, right = above.subplots(1, 2)
    for name, one in done.items():
        losses = torch.tensor(one.losses)
        window = min(25, len(losses))
        smooth = losses.unfold(0, window, 1).mean(-1)
        steps = range(window, len(losses) + 1)
        left.semilogy(steps, smooth, color=COLOURS[name], lw=1.2, label=STROKES[name])
        style = {"color": COLOURS[name], "marker": ".", "ms": 4, "lw": 1.2, "label": STROKES[name]}
        right.semilogy([check.step for check in one.checks], [check.mse for check in one.checks], **style)
    left.set(title="(a) training loss, mean of 25 steps", xlabel="step", ylabel="MSE")
    right.set(title="(b) validation loss, 500 held-out images", xlabel="step", ylabel="MSE")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    right.legend(fontsize=8)
    above.suptitle("One network on three kinds of stroke: exact images of models, not captures", fontsize=11)
    rows = below.subfigures(len(done), 1, squeeze=False)[:, 0]
    for part, (name, one) in zip(rows, done.items(), strict=True):
        axes = part.subplots(2, SAMPLES)
        for k in range(SAMPLES):
            for row, images in enumerate(one.pairs):
                axes[row, k].imshow(1 - images[k].numpy(), cmap="gray", vmin=0, vmax=1)
                axes[row, k].set(xticks=[], yticks=[])
        axes[0, 0].set_ylabel("target", fontsize=7)
        axes[1, 0].set_ylabel("drawn", fontsize=7)
        part.suptitle(STROKES[name], fontsize=9)
    figure.savefig(path, metadata={"Software": None})


def main() -> None:
    """Train, write the picture, print the figures."""
    parser = argparse.ArgumentParser(prog="python -m bench.curves", description="Draw the paper's figures 9 and 12.")
    parser.add_argument("path", nargs="?", type=Path, default=Path("docs/curves.png"))
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    done = trained(options.steps, options.seed)
    draw(done, options.path)
    sys.stdout.writelines(f"# {result.conditions}\n{result.to_line()}\n" for result in results(done, options.seed))


if __name__ == "__main__":
    main()
