"""`bench curves`: one network on three kinds of stroke, its losses as results and as a picture."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import pytest

from bench import curves
from brushloop.model.train.config import preset


def test_every_kind_of_stroke_is_learned_by_the_same_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(curves, "VALIDATION_IMAGES", curves.SAMPLES)
    monkeypatch.setattr(curves, "preset", functools.partial(preset, batch=2))
    done = curves.trained(2, seed=0)
    assert set(done) == {"press", "all", "bezier", "qbc"}
    assert {one.config.target.model for one in done.values()} == {"ccd-bsm", "bezier", "qbc"}
    assert len({(one.config.layers, one.config.learning_rate, one.config.steps) for one in done.values()}) == 1
    assert all(len(one.losses) == len(one.checks) == 2 for one in done.values())
    found = {result.name: result for result in curves.results(done, seed=0)}
    assert found["curves: press"].ratio == 1.0
    assert found["curves: qbc"].value == done["qbc"].checks[-1].mse
    assert "8 inputs" in found["curves: qbc"].conditions
    curves.draw(done, tmp_path / "curves.png")
    assert cv2.imread(str(tmp_path / "curves.png")).shape[1] == 1000


def test_no_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one step"):
        curves.run(n=0)
