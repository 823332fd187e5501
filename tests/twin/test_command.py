"""`brushloop twin`, on an imported session of shallow presses, with a short search."""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.calibrate.errors import CalibrationError
from brushloop.drivers.sim.brush_file import load_brush
from brushloop.twin.file import notes_path
from brushloop.twin.run import PARTS
from brushloop.twin.shape import Found, Round
from tests.photographed import imported_presses
from tests.twin.serial import Serial

CELLS = [(height, tilt) for height in (3.0, 4.0, 5.0) for tilt in (0.0, 5.0)]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sessions") / "presses"
    return imported_presses(tmp_path_factory.mktemp("photos"), out, CELLS, (200, 320), (250, 100))


@contextmanager
def _in_this_process() -> Generator[Executor]:
    yield Serial()


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    first, last = Round(1.0, 1), Round(0.5, 1)
    for name, value in {"COARSE": (first,), "FINE": last, "workers": _in_this_process}.items():
        monkeypatch.setattr(f"brushloop.twin.run.{name}", value)
    monkeypatch.setattr("brushloop.twin.shape.INDIVIDUALS", range(2))
    monkeypatch.setattr("brushloop.twin.run.VOTES", 1)


def made(session: Path, out: Path) -> str:
    ran = CliRunner().invoke(brushloop.__main__.app, ["twin", str(session), "--out", str(out)], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    return " ".join(ran.output.split())


@pytest.mark.usefixtures("short")
def test_a_session_gets_a_twin_and_a_run_that_was_broken_off_goes_on(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, searched = tmp_path / "twin.toml", list[float]()

    def counted(_target: object, found: Found, one: Round, *_: object) -> Found:
        searched.append(one.blur_mm)
        return found  # how a search finds its way is tested beside it

    monkeypatch.setattr("brushloop.twin.run.search", counted)
    with monkeypatch.context() as broken:
        broken.setattr("brushloop.twin.run.covariance", _power_cut)
        with pytest.raises(PowerCut):
            made(session, out)
    assert notes_path(out).exists()
    assert not out.exists()
    assert searched == [1.0, 0.5]

    said = made(session, out)
    assert searched == [1.0, 0.5] * (1 + PARTS)  # those of all cells were not repeated
    unknown = "No cell has three captures", "The camera's noise was not measured"
    for words in ("friction", "a third of the cells left out in turn", "next: brushloop sim --brush", *unknown):
        assert words in said
    assert not notes_path(out).exists()
    assert load_brush(out).name == "simulated bristle bundle (twin of presses, simulated)"
    with pytest.raises(CalibrationError, match="exists: give --out FILE or --replace"):
        made(session, out)


class PowerCut(BaseException):
    pass


def _power_cut(*_: object) -> None:
    raise PowerCut
