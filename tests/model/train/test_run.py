"""A training in a folder: killed and resumed, refused where it is another's."""

from __future__ import annotations

import multiprocessing
import random
from collections.abc import Callable
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from safetensors.torch import load_file

from brushloop.model.train.config import TrainConfig, load_config
from brushloop.model.train.errors import TrainError
from brushloop.model.train.run import run_training

TELLING = """
from pathlib import Path
from brushloop.model.train.config import load_config
from brushloop.model.train.run import run_training

class Reporter:
    def stepped(self, step, loss):
        steps.send(step)
    def validated(self, validation):
        pass

run_training(load_config(Path(toml)), Path(out), Reporter(), lambda: False)
"""


@pytest.fixture(scope="module")
def processes() -> ForkServerContext:
    """Makes processes that begin with everything imported: imports would be most of what they do."""
    context = multiprocessing.get_context("forkserver")
    needed = "pytest torch._dynamo matplotlib.figure skimage.metrics numba brushloop.model.train.run"
    context.set_forkserver_preload(needed.split())
    return context


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, write_tiny: Callable[[Path], Path]) -> Path:
    """The folder of a training that nobody disturbed; tests only read it."""
    folder = tmp_path_factory.mktemp("finished")
    finish(load_config(write_tiny(folder)), folder / "g")
    return folder / "g"


class Silent:
    def stepped(self, step: int, loss: float) -> None: ...

    def validated(self, validation: object) -> None: ...


def finish(config: TrainConfig, folder: Path) -> dict[str, torch.Tensor]:
    run_training(config, folder, Silent(), lambda: False)
    return load_file(folder / "checkpoint.safetensors")


def test_killed_at_random_and_resumed_it_gives_the_same_bits(
    tmp_path: Path, finished: Path, toml: Path, processes: ForkServerContext
) -> None:
    toml.write_text("checkpoint_every = 3\n" + toml.read_text().replace("checkpoint_every = 10\n", ""))
    last = random.randint(1, 28)
    steps, tell = processes.Pipe(duplex=False)
    names = {"toml": str(toml), "out": str(tmp_path), "steps": tell}
    child = processes.Process(target=exec, args=(TELLING, names))
    child.start()
    while steps.recv() != last:
        pass
    child.kill()
    child.join()
    assert not (tmp_path / "generator.safetensors").exists()
    resumed, unbroken = finish(load_config(toml), tmp_path), load_file(finished / "checkpoint.safetensors")
    assert unbroken.keys() == resumed.keys()
    for name, tensor in unbroken.items():
        assert torch.equal(tensor, resumed[name]), f"{name} differs after a kill at step {last}"


def test_the_folder_holds_all_that_the_algorithm_puts_out(finished: Path) -> None:
    left = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()} - {".lock"}
    pictures = {f"pictures/step-{step:07d}.png" for step in (15, 30)}
    files = {
        "checkpoint.safetensors",
        "generator.safetensors",
        "generator.md",
        "samples.safetensors",
        "loss.png",
        "loss.csv",
        "validation.csv",
    }
    assert left == files | pictures
    assert len((finished / "loss.csv").read_text().splitlines()) == 31
    card = (finished / "generator.md").read_text()
    assert "| `depth_mm` | mm | 11 | 20 |" in card
    assert "It has seen no real ink" in card
    assert "30 steps of 16, seed 0, all steps done" in card


def test_a_finished_training_is_not_done_again(finished: Path, tiny: TrainConfig) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.glob("*.*") if path.name != ".lock"}
    finish(tiny, finished)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_another_training_in_the_folder_is_refused_with_the_difference(finished: Path, tiny: TrainConfig) -> None:
    with pytest.raises(TrainError, match="another configuration: steps: 30 -> 40; use a new folder"):
        finish(tiny.model_copy(update={"steps": 40}), finished)


def test_a_folder_in_use_is_refused(tmp_path: Path, tiny: TrainConfig) -> None:
    with FileLock(tmp_path / ".lock"), pytest.raises(TrainError, match="another training writes here"):
        finish(tiny, tmp_path)


def test_cuda_without_a_gpu_is_refused_before_anything_is_written(tmp_path: Path, tiny: TrainConfig) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(TrainError, match="no usable GPU"):
        finish(tiny.model_copy(update={"device": "cuda"}), tmp_path / "g")
    assert not (tmp_path / "g").exists()
