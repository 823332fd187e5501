"""Labs for a collection: without wires unless a test is about sockets, processes or kills."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from brushloop.drivers.arcs import wire
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import rig_toml
from tests import rigs
from tests.rigs import BARE, BENT_VIEW, COARSE, SHARP, Lab

RIG = rig_toml(SimConfig())


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated cabinet may have to wait for its turn on a busy machine."""
    monkeypatch.setattr(wire, "REPLY_S", 30.0)


@pytest.fixture
def rig_path(tmp_path: Path) -> Path:
    """The `rig.toml` of a loopback rig that nobody serves."""
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """Two strokes, and a camera too coarse to judge ink by."""
    with rigs.wireless_lab(tmp_path, COARSE) as lab:
        yield rigs.coarse(lab)


@pytest.fixture
def sharp_lab(tmp_path: Path) -> Iterator[Lab]:
    """One stroke on a small sheet, and a camera sharp enough that captures are judged."""
    with rigs.wireless_lab(tmp_path, SHARP) as lab:
        yield rigs.sharp(lab)


@pytest.fixture
def bent_lab(tmp_path: Path) -> Iterator[Lab]:
    """One stroke on a whole sheet, through a lens that distorts; no lens file is named yet."""
    with rigs.wireless_lab(tmp_path, SimConfig(rate=60.0, view=BENT_VIEW)) as lab:
        yield rigs.sharp(lab, latency_ms=500)


@pytest.fixture
def bare_lab(tmp_path: Path) -> Iterator[Lab]:
    """One stroke by an arm and a camera alone, fast."""
    with rigs.wireless_lab(tmp_path, BARE) as lab:
        rigs.coarse(lab).write_protocol("[15.0]", dwell_s=1.0)
        yield lab


@pytest.fixture
def wired_lab(tmp_path: Path) -> Iterator[Lab]:
    """As `lab`, on sockets and in real time: for processes."""
    with rigs.wired_lab(tmp_path) as lab:
        yield lab
