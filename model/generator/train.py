"""Algorithm 1 of the paper: the training of the generator, in one folder.

It samples H and alpha, draws the stroke, compares and updates. A folder holds `checkpoint.pt` during and after
training, pictures, the losses as CSV (the paper's figure 9), and at the end `generator.safetensors`. The same training
started again resumes at the last checkpoint.
"""

from __future__ import annotations

import io
import json
import math
import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import Tensor

from brushloop.model.generator import TrainError
from brushloop.model.generator.config import TrainConfig, differences
from brushloop.model.generator.data import Captures, Images, Singles, batch_numbers, sets, write_whole
from brushloop.model.generator.network import Generator, squared_error
from brushloop.model.generator.stroke import FORMAT, read_generator
from brushloop.model.similarity import SSIM_SETTINGS, binary_scores, csim, ssim

BLANK_SHARE, BLANKS = 0.05, 2
"""Output is blank if its ink, or its paper, is less than this share of the targets' ink or paper; so many blank
validations in a row end the training."""
SHOWN = 8
"""Validation strokes in a picture."""


def likeness(drawn: NDArray[Any], target: NDArray[Any]) -> NDArray[np.float64]:
    """MSE, IoU and CSIM of (B, N, N) images in [0, 1], (B, 3); IoU counts the pixels that are mostly ink.

    A blank image has a CSIM of 0.
    """
    mse = np.square(np.subtract(drawn, target, dtype=np.float64)).mean((1, 2))
    iou = binary_scores(drawn > 0.5, target > 0.5)[:, 1]
    alike = [csim(a, b) if a.any() and b.any() else 0.0 for a, b in zip(drawn, target, strict=True)]
    return np.column_stack((mse, iou, alike))


def run_training(
    config: TrainConfig, folder: Path, stepped: Callable[[int], object], captures: Captures | None = None
) -> Path:
    """Train to the end, from the folder's checkpoint if it has one; return the generator's path.

    `stepped` is called after each step with its number. torch computes in one thread. Raises TrainError for "cuda"
    without a GPU, if the folder holds another training or is in use, and if the output stays blank or the loss is no
    longer a number.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise TrainError("device", "cuda was asked for, but this machine has no usable GPU")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "generator.safetensors"
    try:
        with FileLock(folder / ".lock", timeout=0):
            torch.set_num_threads(1)
            run = _Training(config, folder, *sets(config, captures))
            run.start(captures)
            while not run.ended:
                run.advance()
                stepped(run.step)
            if not path.exists():
                run.finish(path)
    except Timeout as error:
        raise TrainError(folder, "another training writes in this folder") from error
    return path


def new_network(config: TrainConfig) -> Generator:
    """The network with the weights of the seed; the state of torch's random generator stays unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return Generator(config.target, config.layers)


def learning_rate(config: TrainConfig, step: int) -> float:
    """The rate of a step: rises linearly over the warm-up, then falls along half a cosine to the last step."""
    rise = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    return config.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * step / config.steps))


@dataclass(slots=True, eq=False)
class _Training:
    """A training after `step` steps, with Eq. 6 of every step and (step, MSE) of each validation."""

    config: TrainConfig
    folder: Path
    training: Images
    held_out: Images
    step: int = 0
    losses: list[float] = field(default_factory=list[float])
    validations: list[tuple[int, float]] = field(default_factory=list[tuple[int, float]])
    blanks: int = 0
    network: Generator = field(init=False)
    optimiser: torch.optim.Adam = field(init=False)

    def __post_init__(self) -> None:
        self.network = new_network(self.config).to(self.config.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=self.config.learning_rate, fused=True)

    @property
    def ended(self) -> bool:
        """Whether all steps are done, or the training has converged."""
        converged = bool(self.validations) and self.validations[-1][1] <= self.config.target_mse
        return self.step == self.config.steps or converged

    def start(self, captures: Captures | None) -> None:
        """Continue from the folder's checkpoint, or begin with the weights of the generator to tune."""
        if self._checkpoint.exists():
            self._resume()
        elif captures is not None:
            weights = read_generator(captures.start).weights
            self.network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})

    def advance(self) -> None:
        """Make one step, and what falls due after it."""
        self._update()
        last = self.step == self.config.steps
        if last or self.step % self.config.picture_every == 0:
            self._show()
        if last or self.step % self.config.validate_every == 0:
            self._validate()
            self._save()

    def _update(self) -> None:
        """Make one update by Eq. 6 over the step's batch."""
        config, images = self.config, self.training
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
            self._fail("the loss is no longer a number; train again with a smaller learning_rate")
        self.optimiser.step()
        self.losses.append(value)

    def _validate(self) -> None:
        """Compute the MSE over the validation set; raise TrainError if the output was blank too often."""
        sums = np.zeros(3)
        for drawn, target in self._drawn():
            sums += (
                np.square(np.subtract(drawn, target, dtype=np.float64)).mean((1, 2)).sum(),
                *(images.mean((1, 2)).sum() for images in (drawn, target)),
            )
        mse, ink, wanted = (sums / len(self.held_out)).tolist()
        self.validations.append((self.step, mse))
        is_blank = ink < BLANK_SHARE * wanted or 1 - ink < BLANK_SHARE * (1 - wanted)
        self.blanks = self.blanks + 1 if is_blank else 0
        if self.blanks >= BLANKS:
            what = f"{ink:.2%} of the generator's pixels are ink, but {wanted:.2%} of the targets'"
            self._fail(f"{what}; train again in a new folder with a smaller learning_rate or a larger ink_weight")

    def _fail(self, what: str) -> None:
        raise TrainError(self.folder, f"step {self.step}: {what}")

    def _drawn(self) -> Iterator[tuple[Singles, Singles]]:
        """(drawn, target) batches of the validation set, each (n, N, N)."""
        count = len(self.held_out)
        for numbers in np.array_split(np.arange(count), -(-count // self.config.batch)):
            inputs, target = self.held_out.pick(numbers)
            with torch.no_grad():
                drawn = self.network(torch.from_numpy(inputs).to(self.config.device))
            yield drawn.cpu().numpy(), target

    def _show(self) -> None:
        """Write the picture of Algorithm 1: some validation strokes above what the network draws for them."""
        drawn, target = (np.hstack(list(images[:SHOWN])) for images in next(self._drawn()))
        ink = np.rint(255 * (1 - np.vstack((target, drawn)))).astype(np.uint8)
        pictures = self.folder / "pictures"
        pictures.mkdir(exist_ok=True)
        write_whole(pictures / f"step-{self.step:07d}.png", cv2.imencode(".png", ink)[1].tobytes())

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

    def finish(self, path: Path) -> None:
        """Write the losses, and last the generator with a report of its images of the validation strokes."""
        for name, head, rows in (
            ("loss.csv", "step,loss", enumerate(self.losses, 1)),
            ("validation.csv", "step,mse", self.validations),
        ):
            lines = (head, *(f"{step},{value}" for step, value in rows))
            write_whole(self.folder / name, ("\n".join(lines) + "\n").encode())
        report = _report(self._drawn())
        report |= {"steps": self.step, "end": "all steps done" if self.step == self.config.steps else "converged"}
        state: dict[str, Tensor] = self.network.state_dict()
        weights = {name: np.ascontiguousarray(value.cpu().numpy()) for name, value in state.items()}
        report = json.dumps(report | {"torch": torch.__version__})
        write_whole(path, save(weights, {"format": FORMAT, "config": self.config.model_dump_json(), "report": report}))


def _report(pairs: Iterable[tuple[Singles, Singles]]) -> dict[str, Any]:
    """Means over (drawn, target) batches, and the least SSIM."""
    rows: list[NDArray[np.float64]] = []
    structures: list[float] = []
    for drawn, target in pairs:
        rows.append(likeness(drawn, target))
        structures += [ssim(a, b) for a, b in zip(drawn, target, strict=True)]
    mse, iou, alike = np.concatenate(rows).mean(0).tolist()
    psnr_db = 10 * math.log10(1 / mse) if mse else math.inf
    report = {"images": len(structures), "mse": mse, "psnr_db": psnr_db, "iou": iou, "csim": alike}
    return report | {"ssim": float(np.mean(structures)), "ssim_min": min(structures), "ssim_settings": SSIM_SETTINGS}
