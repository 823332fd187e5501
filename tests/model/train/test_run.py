"""A training in a folder: killed and resumed, shared by two processes, refused where it is another's."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from safetensors.torch import load_file

from model.train.config import TrainConfig, load_config
from model.train.distributed import Group, joined
from model.train.errors import TrainError
from model.train.run import run_training

CHILD = """
import sys
from pathlib import Path
from model.train.config import load_config
from model.train.distributed import Group
from model.train.run import run_training

class Told:
    def stepped(self, step, loss):
        print(step, flush=True)
    def validated(self, validation):
        pass

run_training(load_config(Path(sys.argv[1])), Path(sys.argv[2]), Group(), Told(), lambda: False)
"""


class Silent:
    def stepped(self, step: int, loss: float) -> None: ...

    def validated(self, validation: object) -> None: ...


def finish(config: TrainConfig, folder: Path) -> dict[str, torch.Tensor]:
    run_training(config, folder, Group(), Silent(), lambda: False)
    return load_file(folder / "checkpoint.safetensors")


def test_killed_at_random_and_resumed_it_gives_the_same_bits(tmp_path: Path, toml: Path) -> None:
    toml.write_text("checkpoint_every = 3\n" + toml.read_text().replace("checkpoint_every = 10\n", ""))
    config = load_config(toml)
    unbroken = finish(config, tmp_path / "unbroken")
    last = random.randint(1, 28)
    command = [sys.executable, "-c", CHILD, str(toml), str(tmp_path / "killed")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            if int(line) == last:
                break
        child.send_signal(signal.SIGKILL)
    assert not (tmp_path / "killed" / "generator.safetensors").exists()
    resumed = finish(config, tmp_path / "killed")
    assert unbroken.keys() == resumed.keys()
    for name, tensor in unbroken.items():
        assert torch.equal(tensor, resumed[name]), f"{name} differs after a kill at step {last}"


def test_the_folder_holds_all_that_the_algorithm_puts_out(tmp_path: Path, tiny: TrainConfig) -> None:
    finish(tiny, tmp_path)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} - {".lock"}
    pictures = {f"pictures/step-{step:07d}.png" for step in (15, 30)}
    files = {
        "checkpoint.safetensors",
        "generator.safetensors",
        "generator.md",
        "loss.png",
        "loss.csv",
        "validation.csv",
    }
    assert left == files | pictures
    assert len((tmp_path / "loss.csv").read_text().splitlines()) == 31
    card = (tmp_path / "generator.md").read_text()
    assert "| `height_mm` | mm | 11 | 20 |" in card
    assert "It has seen no real ink" in card
    assert "30 steps of 16, seed 0, all steps done" in card


def test_a_finished_training_is_not_done_again(tmp_path: Path, tiny: TrainConfig) -> None:
    finish(tiny, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.*") if path.name != ".lock"}
    finish(tiny, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_another_training_in_the_folder_is_refused_with_the_difference(tmp_path: Path, tiny: TrainConfig) -> None:
    finish(tiny, tmp_path)
    with pytest.raises(TrainError, match="another configuration: steps: 30 -> 40; use a new folder"):
        finish(tiny.model_copy(update={"steps": 40}), tmp_path)


def test_a_folder_in_use_is_refused(tmp_path: Path, tiny: TrainConfig) -> None:
    with FileLock(tmp_path / ".lock"), pytest.raises(TrainError, match="another training writes here"):
        finish(tiny, tmp_path)


def test_two_processes_share_each_batch_and_reach_the_same_weights(tmp_path: Path, toml: Path) -> None:
    alone = finish(load_config(toml), tmp_path / "alone")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    command = [sys.executable, "-m", "brushloop", "train", "--config", str(toml), "--out", str(tmp_path / "pair")]
    pair = [
        subprocess.Popen(command, env=os.environ | shared | {"RANK": rank, "LOCAL_RANK": rank}, stdout=subprocess.PIPE)
        for rank in ("0", "1")
    ]
    said = [process.communicate()[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0]
    assert b"Generator:" in said[0]
    assert said[1] == b""
    together = load_file(tmp_path / "pair" / "checkpoint.safetensors")
    for name, tensor in alone.items():
        torch.testing.assert_close(together[name], tensor, rtol=1e-3, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")


def test_cuda_without_a_gpu_is_refused() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(TrainError, match="no usable GPU"), joined("cuda"):
        pass
