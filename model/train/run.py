"""One training in one folder: start or resume, write the outputs of Algorithm 1, finish with a generator and its card.

A folder holds `checkpoint.safetensors` during and after training, `generator.safetensors` with `generator.md` at the
end, `samples.safetensors`, `loss.png`, `loss.csv`, `validation.csv` and `pictures/`.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from torch import Tensor

from brushloop.model.generator.metrics import SSIM_SETTINGS, quality
from brushloop.model.generator.network import Generator
from brushloop.model.train.checkpoint import (
    State,
    load_checkpoint,
    load_weights,
    put_weights,
    save_checkpoint,
    save_generator,
    sha256,
)
from brushloop.model.train.config import TrainConfig, differences
from brushloop.model.train.data import Images, exact_sets, load_captures, split
from brushloop.model.train.errors import TrainError
from brushloop.model.train.loop import Progress, Validation, converged, new_state, train
from brushloop.model.train.report import MOST_SAMPLES, Samples, save_samples, write_card, write_curves, write_pictures


@dataclass(frozen=True, slots=True)
class Tuning:
    """The files of a fine-tuning: the generator to start from, and the captures."""

    start: Path
    captures: Path


def run_training(
    config: TrainConfig,
    folder: Path,
    progress: Progress,
    stopping: Callable[[], bool],
    tuning: Tuning | None = None,
) -> Path:
    """Train to the end, from the folder's checkpoint if it has one; return the generator's path.

    Raises TrainError for "cuda" without a GPU and if the folder holds another training or is in use, and as
    `model.train.loop.train`.
    """
    if config.device == "cuda" and not torch.cuda.is_available():
        raise TrainError("device", "cuda was asked for, but this machine has no usable GPU")
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        try:
            held.enter_context(FileLock(folder / ".lock", timeout=0))
        except Timeout as error:
            raise TrainError(folder, "another training writes here") from error
        state = _start(config, folder, tuning)
        done = state.step == config.steps or converged(config, state.validations.tolist())
        path = folder / "generator.safetensors"
        if done and path.exists():
            return path
        sets = _sets(config, tuning)
        files = _Files(config, folder, progress)
        began = time.process_time()
        state = train(config, state, sets, files, stopping)
        _finish(config, folder, state, sets[1], time.process_time() - began)
        return path


def _start(config: TrainConfig, folder: Path, tuning: Tuning | None) -> State:
    """The state to start from: the folder's checkpoint, the generator to tune, or step 0."""
    path = folder / "checkpoint.safetensors"
    if path.exists():
        before, state = load_checkpoint(path)
        for difference in differences(before, config):
            raise TrainError(path, f"was trained with another configuration: {difference}; use a new folder")
        return state
    state = new_state(config)
    if tuning is None:
        return state
    before, network, _ = load_weights(tuning.start)
    for difference in differences(before, before.model_copy(update={"target": config.target, "layers": config.layers})):
        raise TrainError(tuning.start, f"is another generator: {difference}")
    weights = {name: value.detach().clone() for name, value in network.named_parameters()}
    return State(weights, state.moments)


def _sets(config: TrainConfig, tuning: Tuning | None) -> tuple[Images, Images]:
    """Training and validation images."""
    if config.tuning is None:
        return exact_sets(config)
    if tuning is None:
        raise TrainError("captures", "this training learns from captures; name their file")
    if sha256(tuning.captures) != config.tuning.captures_sha256:
        raise TrainError(tuning.captures, "is not the file that this training learns from")
    captures, _ = load_captures(tuning.captures, config)
    return split(captures, config.seed, config.tuning.held_out)


@dataclass(slots=True, eq=False)
class _Files:
    """Writes pictures and checkpoints of a training."""

    config: TrainConfig
    folder: Path
    progress: Progress
    specs: Any = field(init=False)

    def __post_init__(self) -> None:
        self.specs = self.config.build_target().inputs

    def stepped(self, step: int, loss: float) -> None:
        self.progress.stepped(step, loss)

    def validated(self, validation: Validation) -> None:
        self.progress.validated(validation)

    def pictures(self, step: int, inputs: Tensor, targets: Tensor, drawn: Tensor) -> None:
        (self.folder / "pictures").mkdir(exist_ok=True)
        write_pictures(self.folder / "pictures" / f"step-{step:07d}.png", self.specs, inputs, targets, drawn)

    def checkpoint(self, state: State) -> None:
        save_checkpoint(self.folder / "checkpoint.safetensors", self.config, state)


def _finish(config: TrainConfig, folder: Path, state: State, images: Images, cpu_s: float) -> None:
    """Write the generator, its card and the curves."""
    network = config.build_network().eval()
    put_weights(network, state.weights)

    def pairs() -> Any:
        for numbers in torch.arange(len(images)).split(config.batch):
            inputs, target = images.pick(numbers)
            with torch.no_grad():
                yield network(inputs), target

    found = quality(pairs())
    rows = state.validations.tolist()
    end = "converged" if converged(config, rows) else "all steps done"
    report: dict[str, Any] = asdict(found) | {"psnr_db": found.psnr_db, "ssim_settings": SSIM_SETTINGS}
    report |= {"steps": state.step, "end": end, "cpu_s": round(cpu_s, 1), "torch": torch.__version__}
    save_samples(folder, _drawn(network, images))
    write_curves(folder, state, f"{config.target.model}, seed {config.seed}")
    path = folder / "generator.safetensors"
    save_generator(path, config, state.weights, report)
    write_card(path, config, report)


def _drawn(network: Generator, images: Images) -> Samples:
    """Validation strokes, evenly chosen, with what the network draws for them."""
    numbers = torch.linspace(0, len(images) - 1, min(MOST_SAMPLES, len(images))).long()
    inputs, targets = images.pick(numbers)
    with torch.no_grad():
        drawn = network(inputs)
    return Samples(inputs, *((255 * part.clamp(0, 1)).round().to(torch.uint8) for part in (targets, drawn)))


class Bar:
    """A progress bar that shows the latest losses; where there is no terminal, a line for each tenth of the steps."""

    def __init__(self, progress: ProgressBar, steps: int) -> None:
        self._progress, self._steps, self._tenths = progress, steps, 0
        self._task: TaskID = progress.add_task("training", total=steps, loss="", validation="")

    def stepped(self, step: int, loss: float) -> None:
        """See `Progress.stepped`."""
        self._progress.update(self._task, completed=step, loss=f"left, MSE {loss:.1e}")
        if self._progress.console.is_terminal or 10 * step // self._steps <= self._tenths:
            return
        self._tenths = 10 * step // self._steps
        left_s = self._progress.tasks[self._task].time_remaining
        left = f", about {left_s:.0f} s left" if left_s and step < self._steps else ""
        self._progress.console.print(f"training: {step} of {self._steps} steps{left}, MSE {loss:.1e}")

    def validated(self, validation: Validation) -> None:
        """See `Progress.validated`."""
        self._progress.update(self._task, validation=f"held out {validation.mse:.1e}")
        if validation.blank:
            self._progress.console.print(
                f"step {validation.step}: the generator draws {validation.ink_share:.2%} ink where the targets hold "
                f"{validation.target_share:.2%}; training ends if that stays"
            )


def train_with_bar(config: TrainConfig, folder: Path, tuning: Tuning | None = None) -> Path:
    """Train with a progress bar; return the folder. Raises as `run_training`."""
    words = TextColumn("{task.fields[loss]} {task.fields[validation]}")
    columns = (BarColumn(bar_width=16), MofNCompleteColumn(), TimeRemainingColumn(compact=True), words)
    with _asked_to_stop() as stopping, ProgressBar(*columns) as progress:
        path = run_training(config, folder, Bar(progress, config.steps), stopping, tuning)
    card = path.with_suffix(".md")
    progress.console.print(f"Generator: {path}, its card: {card}", markup=False, soft_wrap=True)
    return folder


@contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop after the current step."""
    requests: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, _: requests.append(number)) for number in signals}
    try:
        yield lambda: bool(requests)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
