"""The recipes of CONTRIBUTING.md do what they say."""

from __future__ import annotations

import asyncio
import importlib.util
import sys
import time
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from brushloop.collect.planning.walk import walk
from brushloop.collect.protocols.steps import PressStep
from brushloop.collect.quality.measure import Mark
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_touch import QualityConfig
from brushloop.drivers.camera import CameraOptions, OpenCvCamera
from brushloop.drivers.devices import Ink, Stamp
from brushloop.drivers.errors import LimitExceeded
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim import mjpeg_server
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.faults import ALWAYS, KINDS, Device, Fault
from brushloop.drivers.sim.rig import Addresses, LoopbackRig, rig_toml
from brushloop.model import strokes
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import stroke_models

RECIPES = Path(__file__).resolve().parent.parent / "examples" / "recipes"

SMALL = View(width_px=512, height_px=384, px_per_mm=1.56)


def recipe(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"recipes_{name}", RECIPES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(RECIPES.glob("*.py")), ids=lambda path: path.stem)
def test_a_recipe_has_at_most_sixty_lines_and_is_named_where_people_look(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 60
    assert path.name in (RECIPES.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_a_stroke_model_is_a_file_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "drop.py").write_text((RECIPES / "stroke_model.py").read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(strokes, "__path__", [*strokes.__path__, str(tmp_path)])
    try:
        models = stroke_models(Brush())
        drop, circle = (
            coverage_at(models[name].profile(15.0, 5.0), (15.0, 15.0)).sum().item() for name in ("drop", "circle")
        )
        assert drop == pytest.approx(0.5 * circle, rel=0.01)
    finally:
        sys.modules.pop("brushloop.model.strokes.drop", None)


def test_a_protocol_kind_is_one_class() -> None:
    stairs = recipe("protocol_kind").StairsConfig(kind="stairs", from_mm=10.0, to_mm=14.0, count=3, repeats=2)
    assert [stroke.condition.depth_mm for stroke in stairs.planned()] == [10.0, 12.0, 14.0, 10.0, 12.0, 14.0]
    steps = [
        walked.step
        for walked in walk(
            RigConfig(
                **tomllib.loads(
                    rig_toml(
                        SimConfig(force_sensor=False, ink_device="none"), Addresses("127.0.0.1", 1, 2, 3, None, None)
                    )
                )
            ),
            stairs,
        )
    ]
    presses = [step.press for step in steps if isinstance(step, PressStep)]
    assert [press.condition.depth_mm for press in presses] == [10.0, 12.0, 14.0, 10.0, 12.0, 14.0]
    assert len({step.key for step in steps}) == len(steps)


def test_a_quality_check_is_a_function_of_the_mark() -> None:
    flooded = recipe("quality_check").flooded
    mark = Mark(tone=0.9, uneven=0.05, head_mm=(0.7, 0.0), gap_mm=0.0, bent_deg=0.0, length_mm=20.0, width_mm=8.0)
    assert flooded(mark, QualityConfig()).passed
    assert "Wipe the brush" in flooded(replace(mark, tone=0.99), QualityConfig()).reason


@asynccontextmanager
async def syringe(heard: list[str]) -> AsyncIterator[int]:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := (await reader.readline()).decode().strip():
            heard.append(line)
            writer.write(b"syringe 3\n" if line == "WHO" else b"OK\n")
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1]


async def test_a_driver_has_the_methods_of_its_protocol() -> None:
    heard: list[str] = []
    async with syringe(heard) as port:
        pump = recipe("driver").SyringePump("127.0.0.1", port, HostClock())
        assert isinstance(pump, Ink)
        assert (await pump.connect()).model == "syringe 3"
        await pump.dose(0.5)
        with pytest.raises(LimitExceeded):
            await pump.dose(50.0)
        await pump.close()
        await asyncio.sleep(0)
    assert heard == ["WHO", "DOSE 0.500"]


async def test_a_fault_is_a_kind_and_what_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg_server, "SPOILED", spoiled := dict(mjpeg_server.SPOILED))
    monkeypatch.setitem(KINDS, Device.CAMERA, KINDS[Device.CAMERA])
    recipe("fault").add()
    async with LoopbackRig(SimConfig(force_sensor=False, ink_device="none", view=SMALL)) as rig:
        camera = OpenCvCamera(CameraOptions(f"http://127.0.0.1:{rig.camera.port}/stream.mjpg"), HostClock())
        await camera.connect()
        sound = (await camera.fresh(Stamp(time.time_ns()))).image
        rig.faults.hang(Fault(device=Device.CAMERA, kind="upside-down", count=ALWAYS))
        await camera.fresh(Stamp(time.time_ns()))  # one may be on its way
        turned = (await camera.fresh(Stamp(time.time_ns()))).image
        await camera.close()
    assert "upside-down" in spoiled
    assert np.abs(turned[::-1, ::-1].astype(float) - sound).mean() < 5.0 < np.abs(turned.astype(float) - sound).mean()
