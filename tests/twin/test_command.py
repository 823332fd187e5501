"""`brushloop twin`, on an imported session of shallow presses, with a short search; its files and its processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Generator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.calibrate.artefact import FittedValue
from brushloop.calibrate.compare import Alignment, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.stats import Summary
from brushloop.drivers.sim.brush.spec import BrushSpec, CameraNoise, SoundHead, load_brush
from brushloop.twin.brush import SHAPE
from brushloop.twin.run import PARTS, Twin, TwinStopped, noise_of, twin_toml, workers
from brushloop.twin.search import Solution
from tests.photographed import imported_presses
from tests.twin.test_search import Serial
from tests.waiting import wait_until

CONDITIONS = [(height, tilt) for height in (3.0, 4.0, 5.0) for tilt in (0.0, 5.0)]
HELD_OUT = Stat(
    model="twin", alignment=Alignment.MM, tone=Tone.BINARY, cell=None, csim=Summary(45, 95.1), ssim=Summary(45, 90.2)
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sessions") / "presses"
    return imported_presses(tmp_path_factory.mktemp("photos"), out, CONDITIONS, (200, 320), (250, 100))


@contextmanager
def _in_this_process() -> Generator[Executor]:
    yield Serial()


def twin(session: Path, out: Path) -> str:
    ran = CliRunner().invoke(brushloop.__main__.app, ["twin", str(session), "--out", str(out)], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    return " ".join(ran.output.split())


class PowerCut(BaseException):
    pass


def test_a_session_gets_a_twin_and_a_run_that_was_broken_off_goes_on(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, searched = tmp_path / "twin.toml", list[float]()

    def counted(_target: object, found: Solution, _workers: Executor, blur_mm: float) -> Solution:
        if len(searched) == 2 and not cut:
            cut.append(True)
            raise PowerCut
        searched.append(blur_mm)
        return found  # how a search finds its way is tested with it

    cut: list[bool] = []
    short = {"COARSE_MM": (1.0,), "FINE_MM": 0.5, "workers": _in_this_process, "VOTES": 1, "search": counted}
    for name, value in short.items():
        monkeypatch.setattr(f"brushloop.twin.run.{name}", value)
    monkeypatch.setattr("brushloop.twin.search.INDIVIDUALS", range(2))
    with pytest.raises(PowerCut):
        twin(session, out)
    assert not out.exists()
    assert searched == [1.0, 0.5]

    said = twin(session, out)
    assert searched == [1.0, 0.5] * (1 + PARTS)  # those of all conditions were not repeated
    unknown = "No condition has three captures", "The camera's noise was not measured"
    for words in ("friction", "a third of the conditions left out in turn", "next: brushloop sim --brush", *unknown):
        assert words in said
    assert load_brush(out).name == "simulated bristle bundle (twin of presses, simulated)"
    with pytest.raises(CalibrationError, match="exists: give --out FILE or --replace"):
        twin(session, out)


def test_a_twin_is_read_back_and_what_is_not_determined_has_no_interval(tmp_path: Path) -> None:
    spec = BrushSpec(radius_mm=5.0, length_mm=42.0, friction=0.3, set_deg=9.0, seed=7)
    values = {
        one: FittedValue(value=getattr(spec, one.name), low=None if one.name == "set_deg" else 0.1, high=0.4)
        for one in SHAPE
    }
    fitted = Twin(spec, values, None, (HELD_OUT,), SoundHead(head_mm=2.2, misplaced_mm=4.0))
    path = tmp_path / "twin.toml"
    path.write_text("\n".join(twin_toml(fitted, 'session "1"\n', 1.234)))
    found = load_brush(path)
    assert (found.brush, found.camera, found.quality) == (
        spec,
        CameraNoise(noise=1.23),
        SoundHead(head_mm=2.2, misplaced_mm=4.0),
    )
    assert found.name == "simulated bristle bundle (twin of session ?1??, simulated)"
    lines = {line.split(" = ")[0]: line for line in path.read_text().splitlines()}
    assert lines["friction"].endswith("# 0.1 to 0.4; default 0.22")
    assert lines["set_deg"].endswith("# deg; not determined by these presses; default 8")


def still(sd: float, seed: int) -> np.ndarray:
    """A page under uneven light with one more mark than the still before, as the simulated camera compresses it."""
    page = np.full((240, 320), 200.0) + np.linspace(0.0, 30.0, 320)
    page[20 : 60 + 10 * seed, 40 * seed : 40 * seed + 20] = 30.0
    noisy = np.clip(page + np.random.default_rng(seed).normal(0.0, sd, page.shape), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("sd", [1.0, 5.0])
def test_the_camera_s_noise_is_found_in_stills_of_one_view(sd: float) -> None:
    assert noise_of([still(sd, seed) for seed in range(4)]) == pytest.approx(sd, rel=0.15)
    assert noise_of([still(sd, 1), still(sd, 2)[:100]]) is None


PROGRAM = """
import os, time
from brushloop.twin.run import workers

if __name__ == "__main__":
    with workers(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        list(pool.map(time.sleep, [0.1] * 10_000))
"""


def test_a_command_that_is_killed_leaves_no_process_behind(tmp_path: Path) -> None:
    script = tmp_path / "drawing.py"
    script.write_text(PROGRAM)
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment) as command:
        assert command.stdout is not None
        worker = Path(f"/proc/{int(command.stdout.readline())}/status")
        command.kill()
    wait_until(lambda: not worker.exists() or "(zombie)" in worker.read_text(), "the worker's end")


def test_a_worker_that_ends_first_stops_the_command_in_one_line() -> None:
    with pytest.raises(TwinStopped, match="the same command continues"), workers(1) as pool:
        pool.submit(os._exit, 1).result()
