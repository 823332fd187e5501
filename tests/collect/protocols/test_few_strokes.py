"""`few-strokes`: the first presses span the grid, and the same file always gives the same presses."""

import pytest
from pydantic import ValidationError

from brushloop.collect.protocols.kinds import FewStrokesConfig

GRID = {"kind": "few-strokes", "depths_mm": [11.0, 13.0, 15.0, 17.0, 20.0], "tilts_deg": [0.0, 5.0, 10.0]}


def pressed(**changed: object) -> list[tuple[float, float]]:
    return [
        (p.condition.depth_mm, p.condition.tilt_deg) for p in FewStrokesConfig.model_validate(GRID | changed).planned()
    ]


def test_the_first_four_presses_are_the_corners_of_the_grid() -> None:
    assert set(pressed(strokes=4)) == {(11.0, 0.0), (11.0, 10.0), (20.0, 0.0), (20.0, 10.0)}


def test_more_presses_continue_the_same_order() -> None:
    assert pressed(strokes=9) == pressed(strokes=12)[:9]
    assert len(set(pressed(strokes=15))) == 15
    assert pressed(strokes=20)[15:] == pressed(strokes=5)


def test_every_press_has_a_name_and_a_number_of_its_own() -> None:
    plan = FewStrokesConfig.model_validate(GRID | {"strokes": 31}).planned()
    assert len({p.stroke_id for p in plan}) == 31
    assert [p.index for p in plan] == list(range(31))
    assert (plan[0].stroke_id, plan[15].stroke_id) == ("H11-a0-r01", "H11-a0-r02")


@pytest.mark.parametrize("changed", [{"strokes": 0}, {"tilts_deg": [5.0, 5.0]}, {"seed": 1}])
def test_what_it_does_not_accept(changed: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        FewStrokesConfig.model_validate(GRID | changed)
