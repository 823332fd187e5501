"""The recipes of CONTRIBUTING.md do what they say."""

from __future__ import annotations

import asyncio
import importlib.util
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from collect.protocols.steps import StepKind
from collect.quality.mark import Mark
from collect.rig.config_quality import QualityConfig
from drivers.clock import HostClock
from drivers.errors import LimitExceeded
from drivers.protocols import Ink
from model import strokes
from model.ccdbsm import Brush
from model.coverage import coverage
from model.registry import stroke_models

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
        drop, circle = (
            coverage(models[name].profile(15.0, 5.0), (15.0, 15.0)).sum().item() for name in ("drop", "circle")
        )
        assert drop == pytest.approx(0.5 * circle, rel=0.01)
    finally:
        sys.modules.pop("model.strokes.drop", None)


def test_a_protocol_kind_is_its_values_and_two_functions() -> None:
    stairs = recipe("protocol_kind")
    config = stairs.StairsConfig(kind="stairs", from_mm=10.0, to_mm=14.0, count=3, repeats=2)
    assert [stroke.height_mm for stroke in stairs.planned(config)] == [10.0, 12.0, 14.0, 10.0, 12.0, 14.0]
    generator = stairs.steps(config)
    seen = [next(generator)]
    try:
        while True:
            seen.append(generator.send({"sheet": 0, "cell": len(seen)}))
    except StopIteration:
        pass
    assert [step.kind for step in seen[2:5]] == [StepKind.DIP, StepKind.PRESS, StepKind.CAPTURE]
    assert len({step.key for step in seen}) == len(seen) == 2 + 3 * 6


def test_a_quality_check_is_a_function_of_the_mark() -> None:
    flooded = recipe("quality_check").flooded
    mark = Mark(tone=0.9, uneven=0.05, head_mm=(0.7, 0.0), gap_mm=0.0, bent_deg=0.0)
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
