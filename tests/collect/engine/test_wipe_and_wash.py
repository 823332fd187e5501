"""The dip's extras: across the rim after each dip, and into water before every so many."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.motion import dip_moves, wash_moves
from brushloop.collect.rig.config import RigConfig, load_rig
from tests.runs import wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab

WIPE = "\n[ink.wipe]\nrim_mm = [322.0, 20.0]\nz_mm = 130.0\n"
WASH = "\n[ink.wash]\npot_mm = [305.0, 80.0]\ndip_z_mm = 125.0\nevery_dips = 2\nstrokes = 2\n"


def rig(lab: Lab, extra: str = "") -> RigConfig:
    path = lab.folder / "rig.toml"
    path.write_text(path.read_text(encoding="utf-8") + extra, encoding="utf-8")
    return load_rig(path)


def test_the_brush_leaves_the_well_across_its_rim_and_rises_there(lab: Lab) -> None:
    plain, wiped = dip_moves(rig(lab)), dip_moves(rig(lab, WIPE))
    assert [m.target for m in wiped[:2]] == [m.target for m in plain[:2]]
    assert [round(m.target.z_mm) for m in wiped] == [180, 122, 130, 130, 180]
    assert wiped[-1].target.position_mm[:2] == pytest.approx(wiped[-2].target.position_mm[:2])
    assert wiped[-1].target.position_mm[:2] != pytest.approx(plain[-1].target.position_mm[:2])


def test_washing_goes_down_and_up_so_often(lab: Lab) -> None:
    config = rig(lab, WASH)
    assert config.ink.wash is not None
    assert [round(m.target.z_mm) for m in wash_moves(config, config.ink.wash)] == [180, 125, 152, 125, 152, 180]


def test_a_session_with_both_washes_before_every_second_dip(lab: Lab) -> None:
    rig(lab, WIPE + WASH)
    lab.write_protocol("[11.0]", "[0.0]", repeats=2)
    over_the_pot: list[float] = []
    travelled = lab.rig.world.motion._on_path

    def watch(start, end) -> None:
        x_mm, y_mm = lab.rig.world.to_paper(end.x_mm, end.y_mm)
        if abs(y_mm - 80.0) < 0.1 and abs(x_mm - 305.0) < 0.1 and abs(end.z_mm - 125.0) < 0.1:
            over_the_pot.append(end.z_mm)
        travelled(start, end)

    lab.rig.world.motion._on_path = watch
    engine = lab.engine()
    engine.start()
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 2
    assert len(over_the_pot) == 2  # once, two strokes deep


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (WIPE.replace("322.0", "120.0"), "ink.wipe.rim_mm = .* lies on the sheet"),
        (WIPE.replace("130.0", "250.0"), "ink.wipe.z_mm = 250 is outside"),
        (WASH.replace("305.0", "100.0"), "ink.wash.pot_mm = .* lies on the sheet"),
        (WASH.replace("strokes = 2", "strokes = 0"), "strokes"),
    ],
)
def test_a_place_on_the_sheet_or_a_height_that_cannot_be_is_refused(lab: Lab, extra: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        rig(lab, extra)
