"""A practice sheet shows how a brush is dragged, and a plan learns from ink that lies off and comes out thin."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from brushloop.calibrate.commands import PracticeRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing import Figure, FootprintArtefact, Plan, PlannedBy, as_points
from brushloop.calibrate.writing.compare import Character, WritingComparison, as_ink, round_of, write_written
from brushloop.calibrate.writing.learn import FIGURES, MARGIN, fitted, learned, practice, practice_strokes
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.model.characters.glyph import swept
from brushloop.model.characters.plan import Reach, StrokePath, covered, drawn, first_lead, grid, lead, without_tilt
from brushloop.model.drag import NAMES, START, Drawings, Footprint, inked
from brushloop.sessions.records import Header, Source
from tests.calibrate.given import CALIBRATION

SIDE_MM = 48.0
LINE = StrokePath(np.column_stack((np.linspace(12.0, 36.0, 9), np.full(9, 24.0))), np.full(9, 2.0))
WANTED = swept([LINE], SIDE_MM)


def brush_of(**changed: float) -> Footprint:
    return Footprint(tuple({**dict(zip(NAMES, START, strict=True)), **changed}.values()))


PLANNED = brush_of()
TRUE = brush_of(half_mm_2=-0.1, leash_mm=1.2, across_mm=0.6)
"""The brush that writes: thinner, farther behind and farther to the left than the one that the plan knows."""


def plan_of() -> Plan:
    by = PlannedBy(footprint=PLANNED.values)
    strokes = first_lead([LINE], PLANNED, by.reach, SIDE_MM, 5.0)
    strokes = lead([PLANNED], strokes, WANTED, SIDE_MM, by.reach)
    median = tuple((x, y, 2.0) for x, y in LINE.points.tolist())
    figure = Figure(
        name="bar",
        source="test",
        commanded=as_points(strokes),
        wanted=WANTED,
        simulated=WANTED,
        medians=(median,),
    )
    return Plan(model="footprint", planned_by=by, cell_mm=SIDE_MM, software="test", figures=(figure,))


def came_out(plan: Plan) -> np.ndarray:
    return covered(drawn([TRUE], plan.figures[0].strokes, SIDE_MM, 128), SIDE_MM)


def session(plan: Plan, name: str = "bar", ink: np.ndarray | None = None) -> WritingComparison:
    seen = came_out(plan) if ink is None else ink
    figure = plan.figures[0].model_copy(update={"name": name})
    character = Character(figure, {f"{name}-r01": as_ink(seen)})
    header = Header(session_id="s", source=Source.LOOPBACK, software="test")
    recording = SimpleNamespace(path=Path("s.mcap"))
    opened = SimpleNamespace(header=header, recording=recording, sha256="", calibration=CALIBRATION)
    return WritingComparison(opened, plan, [character])


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_of()


@pytest.fixture(scope="module")
def after(plan: Plan) -> Plan:
    return learned(session(plan))


def test_a_round_brings_the_ink_to_where_it_was_wanted(plan: Plan, after: Plan) -> None:
    def wrong(one: Plan) -> int:
        return np.count_nonzero((came_out(one) > 0.5) != (WANTED > 0.5))

    assert wrong(after) < 0.5 * wrong(plan)
    [found] = after.figures[0].rounds
    assert found.csim_percent < 90.0
    assert set(found.lost_percent) == {"initiation, hidden tip", "execution", "termination, hidden tip"}
    # The ink lay too far left, seen along the stroke to the right: above. The command goes below.
    assert after.figures[0].strokes[0][:, 1].mean() < plan.figures[0].strokes[0][:, 1].mean() - 0.3
    # What the plan knows of the brush is what the ink showed.
    assert after.planned_by.footprint is not None
    drift = dict(zip(NAMES, after.planned_by.footprint, strict=True))["across_mm"]
    assert drift == pytest.approx(0.6, abs=0.3)


def test_after_a_round_that_does_not_help_the_best_one_is_kept(plan: Plan, after: Plan) -> None:
    last = learned(session(after, ink=np.roll(came_out(after), 8, axis=0)))
    [figure] = last.figures
    assert figure.settled
    assert figure.commanded == figure.best == plan.figures[0].commanded
    assert len(figure.rounds) == 2
    # Once settled it stays, whatever the next round shows.
    assert learned(session(last, ink=WANTED)).figures[0].settled


def test_the_report_lists_rounds_and_what_each_phase_lost(after: Plan, tmp_path: Path) -> None:
    written = session(after)
    page = write_written(written, tmp_path, "brushloop write compare").read_text(encoding="utf-8")
    assert "bar: wrong pixels (missing or too much) by phase of the strokes" in page
    assert "<th>phase</th><th>round 1</th><th>these writings</th>" in page
    assert "<td>initiation, hidden tip</td>" in page


def test_a_character_that_was_not_captured_teaches_nothing(plan: Plan) -> None:
    with pytest.raises(CalibrationError, match="shows no 'bar'"):
        learned(session(plan, "other"))


def test_what_is_lost_is_listed_by_phase(plan: Plan) -> None:
    cut = WANTED.copy()
    cut[:, :40] = 0.0  # the first 3 mm of the stroke and its rounding are missing
    lost = round_of(session(plan, ink=cut).characters[0], SIDE_MM).lost_percent
    assert max(lost, key=lambda phase: lost[phase]) == "initiation, hidden tip"
    assert lost["termination, hidden tip"] == 0.0


# The practice sheet, and the footprint that its ink becomes

PATCH_MM = 70.0


def test_a_practice_sheet_is_a_protocol_that_stays_inside_its_cells(tmp_path: Path) -> None:
    protocol = load_protocol(practice(PracticeRequest(tmp_path)).path)
    assert isinstance(protocol, WriteConfig)
    assert len(protocol.figures) == FIGURES
    points = np.concatenate([np.array(stroke.points) for one in protocol.figures for stroke in one.strokes])
    assert points[:, :2].min() >= MARGIN * PATCH_MM - 1e-3
    assert points[:, :2].max() <= (1.0 - MARGIN) * PATCH_MM + 1e-3
    assert points[:, 2].max() <= 14.0


def test_figures_become_a_footprint() -> None:
    true = brush_of(half_mm_2=0.8)
    paths = [without_tilt(stroke) for stroke in practice_strokes(PATCH_MM, Reach(), 34.0)[:4]]
    x_mm, y_mm = grid(PATCH_MM, 70)
    ink = np.array([inked([true] * 2, paths[k : k + 2], x_mm, y_mm) > 0.0 for k in (0, 2)], np.float32)
    footprint, csim_percent = fitted(Drawings(paths, np.array([0, 2, 4]), ink, x_mm, y_mm))
    assert csim_percent > 95.0
    values = dict(zip(NAMES, footprint.values, strict=True))
    about = {"session_id": "practice-01", "source": "loopback rig", "recording_sha256": "", "calibration": ""}
    fields = about | {"software": "test", "images": 2, "strokes": 4, "csim_percent": csim_percent}
    assert FootprintArtefact.model_validate(fields | {"values": values}).footprint() == footprint
    with pytest.raises(ValueError, match="fit the session again with `brushloop write fit`"):
        FootprintArtefact.model_validate(fields | {"values": {"drift_along_mm": 0.0}})
