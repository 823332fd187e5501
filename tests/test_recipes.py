"""The recipes of CONTRIBUTING.md do what they say."""

from __future__ import annotations

import asyncio
import importlib.util
import sys
import time
import tomllib
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.photograph.measure import Mark
from brushloop.collect.protocols.steps import PressStep
from brushloop.collect.rig.config import InkConfig, QualityConfig, RigConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.walk import walk
from brushloop.drivers.camera import CameraTable, OpenCvCamera
from brushloop.drivers.devices import Stamp
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.simulator import Well
from brushloop.drivers.sim import scene
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import ALWAYS, KINDS, Device, Fault
from brushloop.drivers.sim.rig import LoopbackRig, rig_toml
from brushloop.model import strokes
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_models
from tests.rigs import BARE, SHARP, SMALL_TABLE, sharp, wireless_lab
from tests.runs import SteppedEngine, wait_for_end

RECIPES = Path(__file__).resolve().parent.parent / "examples" / "recipes"


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
        marks = (models[name].profile(15.0, 5.0) for name in ("drop", "circle"))
        drop, circle = (float(coverage(mark, (15.0, 15.0)).sum()) for mark in marks)
        assert drop == pytest.approx(0.5 * circle, rel=0.01)
    finally:
        sys.modules.pop("brushloop.model.strokes.drop", None)


def test_a_protocol_kind_is_one_class() -> None:
    stairs = recipe("protocol_kind").StairsConfig(kind="stairs", from_mm=10.0, to_mm=14.0, count=3, repeats=2)
    assert [stroke.condition.depth_mm for stroke in stairs.planned()] == [10.0, 12.0, 14.0, 10.0, 12.0, 14.0]
    rig = RigConfig(**tomllib.loads(rig_toml(SimConfig(force_sensor=False, ink_device="none"))))
    steps = [walked.step for walked in walk(rig, stairs)]
    presses = [step.press for step in steps if isinstance(step, PressStep)]
    assert [press.condition.depth_mm for press in presses] == [10.0, 12.0, 14.0, 10.0, 12.0, 14.0]
    assert len({step.key for step in steps}) == len(steps)


def test_a_quality_check_is_a_function_of_the_mark() -> None:
    flooded = recipe("quality_check").flooded
    mark = Mark(tone=0.9, uneven=0.05, head_mm=(0.7, 0.0), gap_mm=0.0, bent_deg=0.0, length_mm=20.0, width_mm=8.0)
    assert flooded(mark, QualityConfig()).passed
    assert "Wipe the brush" in flooded(replace(mark, tone=0.99), QualityConfig()).reason


SYRINGE = "127.0.0.1", "4000"


async def serve_syringe(well: Well, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Fill this well as a syringe pump does."""
    while line := (await reader.readline()).decode().strip():
        if line != "WHO":
            well.add(float(line.removeprefix("DOSE ")))
        writer.write(b"syringe 3\n" if line == "WHO" else b"OK\n")
    writer.close()


def test_an_ink_device_is_a_table_and_a_driver_and_the_engine_inks_a_brush_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = recipe("driver").SyringeTable

    class InkWithSyringe(InkConfig):
        device: table  # type: ignore[valid-type]  # as it would be in `AnyInkTable`

    class RigWithSyringe(RigConfig):
        ink: InkWithSyringe  # type: ignore[assignment]

    with wireless_lab(tmp_path, replace(SHARP, force_sensor=False, ink_device="none")) as lab:
        well, opened = lab.rig.world.well, lab.rig.connected

        @asynccontextmanager
        async def connected(*of: Any) -> AsyncGenerator[Rig]:
            async with await asyncio.start_server(partial(serve_syringe, well), *SYRINGE), opened(*of) as rig:
                yield rig

        monkeypatch.setattr("brushloop.collect.engine.engine.connected", connected)
        sharp(lab)
        well.ml = 0.0
        fields = tomllib.loads((tmp_path / "rig.toml").read_text(encoding="utf-8"))
        fields["ink"]["device"] = {"kind": "syringe", "port": ":".join(SYRINGE), "dose_ml": 2.0}
        opening = Opening.load(CollectRequest(tmp_path / "rig.toml", tmp_path / "protocol.toml", lab.sessions))
        engine = SteppedEngine(replace(opening, rig=RigWithSyringe(**fields)), None, lab.rig.time)
        engine.start()
        wait_for_end(engine)
    assert engine.snapshot().strokes_done == 1, "its ink was judged"


async def test_a_fault_is_a_kind_and_what_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "SPOILED", spoiled := dict(scene.SPOILED))
    monkeypatch.setitem(KINDS, Device.CAMERA, KINDS[Device.CAMERA])
    recipe("fault").add()
    async with LoopbackRig(replace(BARE, table=SMALL_TABLE)) as rig:
        url = f"http://127.0.0.1:{rig.camera.port}/stream.mjpg"
        camera = OpenCvCamera(CameraTable(kind="opencv", source=url), Clock())
        await camera.connect()
        sound = (await camera.fresh(Stamp(time.time_ns()))).image
        rig.faults.hang(Fault(device=Device.CAMERA, kind="upside-down", count=ALWAYS))
        await camera.fresh(Stamp(time.time_ns()))  # one may be on its way
        turned = (await camera.fresh(Stamp(time.time_ns()))).image
        await camera.close()
    assert "upside-down" in spoiled
    assert np.abs(turned[::-1, ::-1].astype(float) - sound).mean() < 5.0 < np.abs(turned.astype(float) - sound).mean()
