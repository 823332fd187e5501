"""`brushloop train` and `train tune`: captured presses in a generator's image format, and what is written beside it.

That is its card in Markdown, and the page of its training, with held-out strokes as the network draws them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.commands import TrainRequest, TuneRequest
from brushloop.calibrate.compare import FINE, Image, averaged, brush_of
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import Written, write_whole
from brushloop.calibrate.presses import Refused, prepare_press
from brushloop.calibrate.report import BLUE, ORANGE, Point, chart_uri, picture_grid, source_label, write_page
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Prepared
from brushloop.calibrate.validate.command import one_source, open_session
from brushloop.model.ccdbsm import DomainError
from brushloop.model.generator.config import ANCHOR_SHARE, INPUTS, Placement, Target, TrainConfig, load_config, preset
from brushloop.model.generator.data import Captures, Images, sets, sha256
from brushloop.model.generator.stroke import GeneratorFile, load_generator, read_generator
from brushloop.model.similarity import csim
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.terminal import Progress, unseen

PAGE = "training.html"
SAMPLES = 12
SMOOTH_STEPS = 50
MAX_POINTS = 2000
"""Points of the loss curve that are drawn, evenly chosen from all."""
MUCH_ABOVE = 1.5
"""Times its lowest value that the last validation loss may be."""
NUMBERS = (("MSE", "mse", ".3g"), ("PSNR, dB", "psnr_db", ".2f"), ("IoU", "iou", ".5f"), ("CSIM", "csim", ".5f"),
           ("SSIM, mean", "ssim", ".5f"), ("SSIM, least", "ssim_min", ".5f"))  # fmt: skip
"""Label, name and format of the numbers of a report."""


def train(request: TrainRequest, progress: Progress = unseen) -> Written:
    """Train a generator in a folder. Raises `TrainError`."""
    config = preset(request.target) if request.config is None else load_config(request.config)
    return _trained(config, request.out, progress)


def tune(request: TuneRequest, progress: Progress = unseen) -> Written:
    """Fine-tune a generator on the presses of sessions of one source. Raises `TrainError` and `CalibrationError`."""
    read_generator(request.generator)  # refused before any photograph is read
    sessions = [open_session(place) for place in request.sessions]
    one_source(sessions)
    captures, left_out = captures_of(sessions, request.generator)
    steps = request.steps
    config = captures.config(steps=steps, learning_rate=request.learning_rate, validate_every=max(1, steps // 20))
    written = _trained(config, request.out, progress, captures)
    used = f"{len(captures.images)} presses ({captures.source})"
    said = (*(f"left out: {name}: {why}" for name, why in left_out), used, *written.said)
    return Written(written.path, said, left_out)


def captures_of(sessions: Sequence[OpenSession], generator: Path) -> tuple[Captures, list[Refused]]:
    """The presses of sessions of one source in the generator's image format, and those that it is not tuned on.

    Raises as `load_generator` does, and `CalibrationError` where fewer than two conditions are left.
    """
    targets = [load_generator(generator, brush_of(session.header)).target for session in sessions]
    inputs, images, left_out = list[tuple[float, float]](), list[Image](), list[Refused]()
    for session, target in zip(sessions, targets, strict=True):
        for capture in session.recording.captures():
            depth_mm, tilt_deg = capture.stroke.depth_mm, capture.stroke.tilt_deg
            try:
                if depth_mm is None or tilt_deg is None or capture.bad:
                    raise CaptureRefused(capture.stroke.stroke_id, capture.bad or "has no depth or tilt")
                target.check(np.array([[depth_mm, tilt_deg]]))
                images.append(_placed(prepare_press(capture, session.calibration), target))
                inputs.append((depth_mm, tilt_deg))
            except (CaptureRefused, SessionDamaged) as error:
                left_out.append((capture.stroke.stroke_id, error.what))
            except DomainError as error:
                left_out.append((capture.stroke.stroke_id, f"the generator does not draw it: {error}"))
    if len(set(inputs)) < 2:
        what = f"{len(set(inputs))} conditions are left, at least 2 are needed: one to learn from, one to validate on"
        raise CalibrationError(str(sessions[0].recording.path), what)
    label = source_label(sessions[0].header.source, (session.header.brush for session in sessions))
    return Captures(generator, Images(targets[0], np.array(inputs, np.float32), np.array(images)), label), left_out


def _trained(config: TrainConfig, folder: Path, progress: Progress, captures: Captures | None = None) -> Written:
    """Train in the folder, and write the generator's card and the page."""
    from brushloop.model.generator.train import run_training  # loads torch

    progress("training", 0, config.steps)
    path = run_training(config, folder, lambda step: progress("training", step, config.steps), captures)
    file = read_generator(path)
    losses, checks = (
        np.loadtxt(path.with_name(name), delimiter=",", skiprows=1, ndmin=2) for name in ("loss.csv", "validation.csv")
    )
    label = config.tuning.source if config.tuning else "exact images of a stroke model"
    facts, trust = list(_facts(file, path)), list(_trust(file, checks))
    card = path.with_suffix(".md")
    write_whole(card, _card(path.name, facts, trust))
    page = write_page(
        path.with_name(PAGE),
        "training.html.j2",
        label=label,
        note="captured strokes: tuned on some of them, judged by the others"
        if config.tuning
        else "the network learns to draw what a closed-form model draws: no ink, neither real nor simulated",
        samples=sorted(_samples(file, captures), key=lambda sample: sample["csim"]),
        trust=trust,
        losses=_losses(losses, checks, label),
        facts=facts,
    )
    return Written(path, (f"Generator: {path}, its card: {card}", f"Page: {page}"))


def _samples(file: GeneratorFile, captures: Captures | None) -> Iterator[dict[str, Any]]:
    """Target, network and difference of some held-out strokes, spread evenly over them."""
    _, held_out = sets(file.config, captures)
    chosen = np.linspace(0, len(held_out) - 1, min(SAMPLES, len(held_out))).round().astype(int)
    inputs, targets = held_out.pick(chosen)
    for values, target, drawn in zip(inputs, targets, file.images(inputs), strict=True):
        yield {
            "name": ", ".join(f"{name} {value:.3g}" for name, value in zip(INPUTS, values, strict=True)),
            "csim": 100.0 * csim(target, drawn) if target.any() and drawn.any() else 0.0,
            "target": target,
            "drawn": drawn,
        }


def _trust(file: GeneratorFile, checks: NDArray[np.float64]) -> Iterator[Point]:
    """What to know of it; `checks` (k, 2) are step and MSE of each validation."""
    if file.config.tuning:
        yield Point(None, "The generator was tuned on captures: similar captures are no independent test of it.")
    else:
        yield Point(None, "The network saw no real ink: on paper, it at best equals the closed-form model it learned.")
    if len(checks) > 1:
        last, lowest = checks[-1], checks[np.argmin(checks[:, 1])]
        if last[1] > MUCH_ABOVE * lowest[1]:
            words = f"was lowest at step {lowest[0]:.0f} and {last[1] / lowest[1]:.1f} times as high at the end"
            yield Point(False, f"The validation loss {words}: the network memorises its training strokes.")
        else:
            yield Point(True, f"The validation loss is at its lowest, or near it, at the end (step {last[0]:.0f}).")
    yield Point(None, "Outside the ranges of its inputs the generator extrapolates polynomials: do not use it there.")


def _losses(losses: NDArray[np.float64], checks: NDArray[np.float64], label: str) -> str:
    """Training loss of the steps with its running mean, and the validation losses: the paper's figure 9."""
    steps, losses = losses.T
    every = slice(None, None, max(1, -(-len(losses) // MAX_POINTS)))
    figure, [[axis]] = picture_grid(1, 1, (10.6, 4.0), f"losses ({label})")
    axis.plot(steps[every], losses[every], color="#bfbfbf", linewidth=0.7, label="training, Eq. 6, each step")
    if len(losses) > 10 * SMOOTH_STEPS:
        mean = np.convolve(losses, np.full(SMOOTH_STEPS, 1.0 / SMOOTH_STEPS), "valid")
        smooth = f"mean of {SMOOTH_STEPS} steps"
        axis.plot(steps[SMOOTH_STEPS - 1 :][every], mean[every], color=BLUE, linewidth=1.2, label=smooth)
    axis.plot(*checks.T, "o-", color=ORANGE, markersize=4, linewidth=1.2, label="validation, MSE")
    axis.set(xlabel="step", ylabel="loss", yscale="log")
    return chart_uri(figure)


def _facts(file: GeneratorFile, path: Path) -> Iterator[tuple[str, str]]:
    config, report, target, tuning = file.config, file.report, file.config.target, file.config.tuning
    side_mm = target.size_px * target.px_mm
    yield "generator", f"{path.name}, sha256 {sha256(path)}"
    yield "learned from", f"exact area coverage of the stroke model {target.model}"
    if tuning:
        yield "tuned on", f"captures of {tuning.source}, sha256 {tuning.captures_sha256}"
        yield "started from", f"sha256 {tuning.start_sha256}"
    fitted = " (fitted to captures)" if target.fitted_brush else ""
    yield "brush", f"R {target.radius_mm:g} mm, L {target.length_mm:g} mm, lambda {target.lam:.5g}{fitted}"
    low, high = zip(target.depth_mm, target.tilt_deg, strict=True)
    yield "inputs", f"H from {low[0]:g} to {high[0]:g} mm, alpha from {low[1]:g} to {high[1]:g} deg"
    yield (
        "image",
        f"{target.size_px} x {target.size_px} px of {target.px_mm:g} mm ({side_mm:g} mm a side), ink 1 on 0, "
        f"placement {target.placement}, heading 0",
    )
    layers = ", ".join(f"{name} {value}" for name, value in config.layers.model_dump().items())
    yield "network", f"{config.weight_count:,} weights; {layers}"
    yield (
        "training",
        f"{report.get('steps')} steps of {config.batch}, seed {config.seed}, highest rate {config.learning_rate:g}: "
        f"{report.get('end')}; torch {report.get('torch')}",
    )
    images = "captured strokes that were held out" if tuning else "exact images kept out of the training"
    yield "judged by", f"{report.get('images')} {images}; {report.get('ssim_settings')}"
    for name, key, form in NUMBERS:
        if isinstance(value := report.get(key), int | float):
            yield name, format(value, form)


def _card(name: str, facts: list[tuple[str, str]], trust: list[Point]) -> str:
    """The card as Markdown, without characters of other people's texts that Markdown or HTML would interpret."""
    lines = [f"# {name}", "", "A network that draws the press of a brush.", "", "| | |", "|---|---|"]
    lines += [f"| {what} | {_plain(text)} |" for what, text in facts]
    lines += ["", "## Limits", "", *(f"- {_plain(point.text)}" for point in trust if not point.good)]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return "".join(c if c.isalnum() or c in " .,;-_()/:+" else "?" for c in text)


def _placed(prepared: Prepared, target: Target) -> Image:
    """(N, N) share of ink in each pixel of the generator. Raises `CaptureRefused` for a stroke that is cut or large."""
    if prepared.cut:
        raise CaptureRefused("capture", "is cut by the edge of its photograph or patch")
    step_px = target.px_mm * PX_PER_MM
    side_px = target.size_px * step_px
    assert prepared.anchor_px is not None  # prepare_press aligns every press with its point of touch
    if target.placement is Placement.CENTRED:
        rows, columns = (np.flatnonzero(prepared.mask.any(axis=axis)) for axis in (1, 0))
        left, top = (0.5 * (ends[0] + ends[-1] + 1 - side_px) for ends in (columns, rows))
    else:
        left, top = (at - share * side_px for at, share in zip(prepared.anchor_px, ANCHOR_SHARE, strict=True))
    # At least as fine as the mask itself, else thin ink would fall between the samples.
    fine = max(FINE, math.ceil(step_px))
    coverage = averaged(prepared.mask.astype(np.float32), (float(left), float(top)), step_px, target.size_px, fine)
    image = np.clip(coverage, 0.0, 1.0)
    inked_px = float(np.count_nonzero(prepared.mask))
    if abs(float(image.sum()) * step_px**2 - inked_px) > 0.01 * inked_px:
        raise CaptureRefused("capture", "is larger than the generator's image")
    return image
