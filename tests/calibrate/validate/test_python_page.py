"""What one types in a notebook: the page of docs, the example, and an import that loads nothing heavy."""

from __future__ import annotations

import io
import os
import runpy
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

import brushloop
from brushloop.calibrate.compare import MM_PER_PX
from tests.blocks import ROOT, blocks_of
from tests.calibrate.conftest import CONDITIONS
from tests.photographed import imported_presses


def test_the_import_loads_nothing_heavy_and_models_are_drawn_without_torch() -> None:
    heavy = ("torch", "cv2", "textual", "numpy", "typing", "pydantic")
    code = f"""
import sys, brushloop
print([name for name in {heavy} if name in sys.modules])
for model in brushloop.models():
    brushloop.predict(brushloop.Condition(15.0, 5.0), model=model)
print("torch" in sys.modules)
"""
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\nFalse\n"


def test_every_name_of_the_door_is_there_and_no_other() -> None:
    for name in brushloop.__all__:
        assert getattr(brushloop, name).__name__ == name
    assert set(brushloop.__all__) <= set(dir(brushloop))
    with pytest.raises(AttributeError, match="no attribute 'presses'"):
        _ = brushloop.presses  # pyright: ignore[reportAttributeAccessIssue]


def test_the_blocks_of_the_page_run_in_order(tmp_path: Path, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(session, tmp_path / "presses")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    said = io.StringIO()
    with redirect_stdout(said):
        for block in blocks_of(ROOT / "docs" / "python.md"):
            if block.kind == "python":
                exec(compile(block.text, str(block), "exec"), names)
    assert "11 presses" not in said.getvalue()
    assert said.getvalue().count("not used:") == 1  # the blank capture


def test_a_press_has_its_pictures_and_its_condition(session: Path) -> None:
    press = next(brushloop.Session(session).presses())
    assert press.image.shape == press.mask.shape == (600, 960)  # 300 x 480 px at 10 px/mm, at 20
    assert press.image.dtype == np.uint8
    assert press.image[press.mask].mean() < press.image[~press.mask].mean() - 50
    assert press.photograph.shape == (300, 480)
    assert press.condition == brushloop.Condition(depth_mm=11.0, tilt_deg=0.0)
    assert press.poses["x_mm"].shape == press.forces["fx_n"].shape == (0,)
    assert press.reached_mm is None


@pytest.mark.parametrize("model", brushloop.models())
def test_a_model_draws_a_press_as_an_image_and_as_an_outline_of_one_area(model: str) -> None:
    predicted = brushloop.predict(brushloop.Condition(depth_mm=13.0, tilt_deg=5.0), model=model)
    area_mm2 = float(predicted.image.sum()) * MM_PER_PX**2
    x, y = predicted.outline_mm.T
    assert abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2 == pytest.approx(area_mm2, rel=0.01)
    assert brushloop.compare(predicted.image, predicted.image) == pytest.approx((1.0, 1.0))


def test_the_example_runs_on_a_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = imported_presses(tmp_path, CONDITIONS, blank=True)
    monkeypatch.setattr(sys, "argv", ["notebook.py", os.fspath(folder)])
    runpy.run_path(str(ROOT / "examples" / "notebook.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert sum("CSIM" in line for line in lines) == 5
    assert Path(lines[-1]).is_file()
