"""The page of a training: held-out strokes as the network draws them, losses, and what the generator is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.report import (
    BLUE,
    ORANGE,
    Image,
    Point,
    dress,
    ink_uri,
    overlay_uri,
    plot,
    plot_uri,
    shortened,
    write_page,
)
from brushloop.model.generator.card import NUMBERS, load_samples, read_curves
from brushloop.model.generator.config import INPUTS, TrainConfig
from brushloop.model.generator.data import sha256
from brushloop.model.generator.stroke import read_generator
from brushloop.model.similarity import csim

PAGE = "training.html"
SMOOTH_STEPS = 50
MAX_POINTS = 2000
"""Points of the loss curve that are drawn, evenly chosen from all."""
MUCH_ABOVE = 1.5
"""Times its lowest value that the last validation loss may be."""
EXACT = "exact images of a stroke model"


def write_training_page(folder: Path) -> Path:
    """Write the page of the finished training in `folder`; returns its path.

    Raises TrainError for a folder that holds no finished training, and OSError.
    """
    path = folder / "generator.safetensors"
    file = read_generator(path)
    config, report = file.config, file.report
    losses, checks = read_curves(folder)
    label = config.tuning.source if config.tuning else EXACT
    return write_page(
        folder / PAGE,
        "training.html.j2",
        label=label,
        note=_note(config),
        samples=list(_samples(folder)),
        images=f"{config.target.size_px} × {config.target.size_px} pixels of {config.target.px_mm:g} mm",
        verdict=list(_verdict(config, report)),
        trust=list(_trust(config, report, checks)),
        losses=_losses(losses, checks, label),
        likeness=_likeness(checks, label) if len(checks) > 1 else "",
        tuned=config.tuning is not None,
        numbers=list(_numbers(report)),
        inputs=(
            ("depth_mm", "mm", config.target.depth_mm, "H, how far the tip is pressed below the paper"),
            ("tilt_deg", "deg", config.target.tilt_deg, "alpha, the brush axis from the vertical"),
        ),
        facts=list(_facts(config, report, path)),
    )


def _note(config: TrainConfig) -> str:
    if config.tuning:
        return "captured strokes: tuned on some of them, judged by the others"
    return "the network learns to draw what a closed-form model draws: no ink, neither real nor simulated"


def _samples(folder: Path) -> Iterator[dict[str, Any]]:
    """Target, network and difference of each stroke that the training kept, the worst first."""
    samples = load_samples(folder)
    targets, images = (list(np.asarray(stack, np.float32)) for stack in (samples.targets, samples.drawn))
    scores = [_score(target, drawn) for target, drawn in zip(targets, images, strict=True)]
    for k in sorted(range(len(scores)), key=lambda k: scores[k]):
        target, drawn = targets[k], images[k]
        yield {
            "name": ", ".join(f"{name} {value:.3g}" for name, value in zip(INPUTS, samples.inputs[k], strict=True)),
            "csim": f"{100.0 * scores[k]:.2f}",
            "images": {
                "target": ink_uri(target),
                "network": ink_uri(drawn),
                "difference": overlay_uri(target, drawn),
            },
        }


def _score(target: Image, drawn: Image) -> float:
    return csim(target, drawn) if target.any() and drawn.any() else 0.0


def _verdict(config: TrainConfig, report: dict[str, Any]) -> Iterator[str]:
    end = f"{report.get('steps')} steps: {report.get('end')}"
    yield f"The network has {config.weight_count:,} weights and was trained for {end}."
    score = report.get("csim")
    if isinstance(score, int | float):
        which = "captured strokes that were held out" if config.tuning else "strokes that it was not trained on"
        yield f"On {report.get('images')} {which} its images reach a CSIM of {100.0 * score:.2f} %."


def _trust(config: TrainConfig, report: dict[str, Any], checks: NDArray[np.float64]) -> Iterator[Point]:
    if config.tuning:
        words = f"Tuned on captures of: {config.tuning.source}. Captures of the same kind are not an independent test."
    else:
        words = "It has seen no ink, so on paper it is no better than the closed-form model that it learned."
    yield Point(None, words)
    if len(checks) > 1:
        best = int(np.argmin(checks[:, 1]))
        last, lowest = checks[-1, :2], checks[best, :2]
        if last[1] > MUCH_ABOVE * lowest[1]:
            words = f"was lowest at step {lowest[0]:.0f} and is {last[1] / lowest[1]:.1f} times that at the end"
            yield Point(False, f"The validation loss {words}: the network memorises its training strokes.")
        else:
            yield Point(True, f"The validation loss is at its lowest, or near it, at the end (step {last[0]:.0f}).")
    yield Point(None, "Outside the ranges of its inputs it extrapolates polynomials: do not use it there.")


def _losses(losses: NDArray[np.float64], checks: NDArray[np.float64], label: str) -> str:
    """Training loss of the steps with its running mean, and the validation losses: the paper's figure 9."""
    figure, axis = plot(1, 1, (10.0, 3.8))
    steps = np.arange(1, len(losses) + 1)
    every = slice(None, None, max(1, -(-len(losses) // MAX_POINTS)))
    axis.semilogy(steps[every], losses[every], color="0.75", lw=0.6, label="training, Eq. 6, each step")
    if len(losses) > 10 * SMOOTH_STEPS:
        mean = np.convolve(losses, np.full(SMOOTH_STEPS, 1.0 / SMOOTH_STEPS), "valid")
        axis.semilogy(
            steps[SMOOTH_STEPS - 1 :][every], mean[every], color=BLUE, lw=1.2, label=f"mean of {SMOOTH_STEPS} steps"
        )
    if len(checks):
        axis.semilogy(checks[:, 0], checks[:, 1], ".-", color=ORANGE, lw=1.2, label="validation, MSE")
    dress(axis, f"losses ({shortened(label, 60)})", "step", "loss", legend=True)
    return plot_uri(figure)


def _likeness(checks: NDArray[np.float64], label: str) -> str:
    figure, axis = plot(1, 1, (6.4, 3.4))
    for column, name, colour in ((3, "CSIM", BLUE), (2, "IoU", ORANGE)):
        axis.plot(checks[:, 0], 100.0 * checks[:, column], ".-", color=colour, lw=1.2, label=name)
    dress(axis, f"likeness on held-out strokes ({shortened(label, 60)})", "step", "percent", legend=True)
    return plot_uri(figure)


def _numbers(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for label, name, form in NUMBERS:
        value = report.get(name)
        if isinstance(value, int | float):
            yield label, format(value, form)


def _facts(config: TrainConfig, report: dict[str, Any], path: Path) -> Iterator[tuple[str, str]]:
    target = config.target
    yield (
        "stroke model",
        f"{target.model}, R {target.radius_mm:g} mm, L {target.length_mm:g} mm, λ {target.lam:.5g}",
    )
    yield "network", ", ".join(f"{name} {value}" for name, value in config.layers.model_dump().items())
    yield "training", f"{config.batch} images a step, seed {config.seed}, highest rate {config.learning_rate:g}"
    if config.tuning:
        yield "captures", f"{config.tuning.source}, sha256 {config.tuning.captures_sha256}"
        yield "started from", f"sha256 {config.tuning.start_sha256}"
    yield "CPU time", f"{report.get('cpu_s')} s since the last start; torch {report.get('torch')}"
    yield "generator", f"{path.name}, sha256 {sha256(path)}; its card is {path.with_suffix('.md').name}"
