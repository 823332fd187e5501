"""What the chains of commands do in which order, keep, and refuse before anything moves; one of them on a rig."""

from __future__ import annotations

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.commands import PROTOCOL, ValidateRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.validate import command
from brushloop.calibrate.validate.command import ValidationOutput
from brushloop.calibrate.writing import FILE as PLAN
from brushloop.calibrate.writing import Figure, Plan, PlannedBy
from brushloop.calibrate.writing.compare import ANOTHER, PLANNED, REFERENCE, SIMULATED, WrittenRecord
from brushloop.collect.chains import LoopRequest, WritingRequest, demo, loop, writing
from brushloop.collect.chains.loop import SETTINGS as FILE
from brushloop.collect.chains.loop import Settings, begun_with, check_recovered, run_loop
from brushloop.collect.chains.writing import FOOTPRINT, Writing
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import ConfigError, StrokesLeftOut
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import finished_session
from brushloop.drivers.loopback import simulate
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from tests.collect.conftest import RIG
from tests.command import refused, said
from tests.sessions.conftest import Make

# The demo

GRID = 'kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 1\nseed = 1\n'


class Chain:
    """Stands for rig and commands: notes them; `collect` makes a finished session, the others their reports."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.left_out = 0
        self.validate_fails = False

    def collect(self, request: CollectRequest) -> Snapshot:
        self.ran.append("collect")
        number = 1 + len(list(request.out.glob("*")))
        session = finished(request.config, request.protocol, request.out, number)
        return Snapshot(folder=str(session), given_up=self.left_out)

    def validated(self, request: ValidateRequest, _progress: object) -> ValidationOutput:
        self.ran.append("validate")
        if self.validate_fails:
            raise CalibrationError(str(request.places[0]), "cannot be validated")
        report = Path(request.places[0]) / "validation" / "report.html"
        report.parent.mkdir()
        report.write_text("report")
        return ValidationOutput(report.parent)

    def loop(self, request: LoopRequest) -> None:
        assert request.out is not None
        self.ran.append(f"loop {request.presses}")
        request.out.mkdir()
        (request.out / "loop.html").touch()

    def write(self, request: WritingRequest) -> None:
        self.ran.append(f"write {request.what} {request.repeats}")
        request.out.mkdir()
        (request.out / "written.html").touch()

    def rig(self, config: Path, *_options: object, **_more: object) -> SimpleNamespace:
        self.ran.append("rig")
        config.write_text(RIG)
        return SimpleNamespace(config=config, fresh_sheet=lambda: self.ran.append("fresh sheet"), end=lambda: None)


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Chain:
    made = Chain()
    monkeypatch.setattr(demo, "collect", made.collect)
    monkeypatch.setattr(command, "validate", made.validated)
    monkeypatch.setattr(demo, "calibrated", lambda _session: made.ran.append("calibrate"))
    monkeypatch.setattr(demo, "fitted", lambda _session: made.ran.append("fit"))
    monkeypatch.setattr(demo, "run_loop", made.loop)
    monkeypatch.setattr(demo, "start", made.rig)
    monkeypatch.setattr(demo, "write", made.write)
    return made


def finished(config: Path, protocol: Path, out: Path, number: int) -> Path:
    """A finished session of this protocol with what that rig holds."""
    rig = load_rig(config)
    known = {"brush": rig.brush.name, "ink": rig.ink.name, "paper": rig.paper.name}
    asked = {"session_id": f"grid-{number}", "protocol": load_protocol(protocol).model_dump_json()}
    Make().session(out / f"grid-{number}", closed=True, **known, **asked)
    return out / f"grid-{number}"


EVALUATED = ["calibrate", "fit", "fresh sheet", "loop 6", "validate"]


def run(folder: Path, *more: str) -> None:
    """Run the command. Raises what ended it."""
    CliRunner().invoke(app, ["demo", "--out", str(folder), *more], catch_exceptions=False)


def test_strokes_that_were_left_out_end_in_a_report_that_can_be_opened_and_exit_code_3(
    chain: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    chain.left_out = 2
    with pytest.raises(StrokesLeftOut, match="2 strokes failed") as left_out:
        run(tmp_path, "--open", "--full")
    assert [url.endswith("grid-1/validation/report.html") for url in opened] == [True]
    assert left_out.value.exit_code == 3
    again = ["calibrate", "fit", "fresh sheet", "loop 15"]
    assert chain.ran == ["rig", "collect", *again, "fresh sheet", "write 字 4", "validate"], "the full demo also writes"
    assert (tmp_path / "sessions" / "grid-1" / "validation" / "report.html").is_file()


def test_a_demo_that_ended_after_its_collection_goes_on_there_and_begins_no_new_session(
    chain: Chain, tmp_path: Path
) -> None:
    chain.validate_fails = True
    with pytest.raises(CalibrationError, match="cannot be validated"):
        run(tmp_path)
    chain.validate_fails = False
    chain.ran.clear()
    run(tmp_path)
    # The presses that were made again are there: no rig, and no sheet, is needed.
    assert chain.ran == ["calibrate", "fit", "validate"]
    chain.ran.clear()
    run(tmp_path)
    assert chain.ran == ["rig", "collect", *EVALUATED]
    assert sorted(path.name for path in (tmp_path / "sessions").iterdir()) == ["grid-1", "grid-2"]


# The loop

SETTINGS = Settings(
    original="grid-01",
    original_sha256="ab",
    fit="cd",
    depth_range_mm=(2.0, 22.0),
    tilt_range_deg=(0.0, 15.0),
    seed=1,
)


def test_a_loop_goes_on_with_what_it_was_begun_with_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "loop"
    assert begun_with(SETTINGS, folder) == SETTINGS
    assert begun_with(SETTINGS.model_copy(update={"fit": "ef"}), folder) == SETTINGS, "another fit was made since"
    for name, value in (("original_sha256", "xy"), ("depth_range_mm", (2.0, 20.0)), ("presses", 5)):
        with pytest.raises(ConfigError, match=f"{name}: this folder was begun with"):
            begun_with(SETTINGS.model_copy(update={name: value}), folder)
    (folder / FILE).write_text("{}")
    with pytest.raises(ConfigError, match="holds no settings of `brushloop repress`"):
        begun_with(SETTINGS, folder)


def test_presses_that_cannot_be_made_again_are_refused_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "calibrated", pytest.fail)
    rig, protocol = tmp_path / "rig.toml", tmp_path / "protocol.toml"
    rig.write_text(RIG, encoding="utf-8")
    protocol.write_text(GRID, encoding="utf-8")
    session = finished(rig, protocol, tmp_path / "sessions", 1)
    with pytest.raises(ConfigError, match="would press on the sheet that is in place"):
        run_loop(LoopRequest(session, rig))
    rig.write_text(RIG.replace("simulated bristle bundle", "goat hair"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"brush\.name: 'goat hair, seed 1', but the session was pressed with"):
        run_loop(LoopRequest(session, rig, sheet=1))


def test_a_fit_that_does_not_describe_the_brush_is_not_pressed(tmp_path: Path) -> None:
    path = tmp_path / "recovered.csv"
    path.write_text("stroke_id,flags\na,\nb,at_bound\nc,\nd,at_bound\n")
    check_recovered(path)
    path.write_text("stroke_id,flags\na,\nb,at_bound\nc,upright at_bound\n")
    with pytest.raises(ConfigError, match="2 of 3 recovered presses lie at a limit"):
        check_recovered(path)


def test_a_session_of_another_ink_is_not_the_one_that_a_chain_asks_for(tmp_path: Path) -> None:
    """The same protocol was pressed with two inks: each rig.toml finds its own session, and a third ink finds none."""
    protocol = tmp_path / "protocol.toml"
    protocol.write_text(GRID)
    rigs = {ink: tmp_path / f"{ink}.toml" for ink in ("sumi", "walnut", "red")}
    for ink, path in rigs.items():
        path.write_text(RIG.replace("simulated ink", ink), encoding="utf-8")
    root = tmp_path / "sessions"
    for number, ink in enumerate(("sumi", "walnut"), 1):
        finished(rigs[ink], protocol, root, number)
    assert finished_session(root, rigs["sumi"], protocol) == root / "grid-1"
    assert finished_session(root, rigs["walnut"], protocol) == root / "grid-2"
    assert finished_session(root, rigs["red"], protocol) is None


# Writing

CELL = 'kind = "write"\ncell_mm = [48.0, 48.0]\nrepeats = {repeats}\n[[figures]]\nname = "子"\n[[figures.strokes]]\n'
POINTS = "points = [[10.0, 24.0, 3.0, 0.0, 0.0], [20.0, 24.0, 3.0, 0.0, 0.0]]\n"


class Commands:
    """Stands in for brushloop's commands: notes each, and writes what it would leave."""

    def __init__(self, settled_after: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ran: list[str] = []
        self._settled_after = settled_after
        for name in ("plan", "compare.compare", "learn.learn", "learn.practice", "learn.fit"):
            command = functools.partial(self._run, name.split(".")[-1])
            monkeypatch.setattr(f"brushloop.calibrate.writing.{name}", command)

    def _run(self, name: str, request: Any, _: object) -> Written:
        self.ran.append(name)
        if name == "fit":
            return Written(request.session / FOOTPRINT / "0123456789abcdef.json", ())
        if name == "compare":
            return Written(request.out / "written.html", ())
        settled = self.ran.count("learn") >= self._settled_after
        repeats = 1 if name == "practice" else request.settled_repeats if settled else request.repeats
        request.out.mkdir(parents=True)
        (request.out / PROTOCOL).write_text(CELL.format(repeats=repeats) + POINTS, encoding="utf-8")
        figure = Figure(name="子", source="", settled=settled)
        plan = Plan(model="", planned_by=PlannedBy(), cell_mm=48.0, software="", figures=(figure,))
        (request.out / PLAN).write_text(plan.model_dump_json(), encoding="utf-8")
        return Written(request.out / PROTOCOL, ())


@pytest.mark.parametrize(("settled_after", "rounds"), [(1, 1), (9, 3)])
def test_practice_comes_first_and_learning_ends_when_all_is_settled(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    settled_after: int,
    rounds: int,
) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    commands = Commands(settled_after, monkeypatch)
    monkeypatch.setattr(writing, "collected_session", lambda *_: tmp_path / "session")
    request = WritingRequest(
        "子", tmp_path / "rig.toml", tmp_path / "out", tmp_path, repeats=10, learn=3, practice=True
    )
    assert Writing(request).run() == tmp_path / "out" / "written.html"
    assert commands.ran == ["practice", "fit", "plan", *["compare", "learn"] * rounds, "compare"]
    assert ("improved no character" in capsys.readouterr().out) == (rounds < 3)


def test_a_fresh_sheet_is_asked_for_before_anything_is_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = Commands(1, monkeypatch)
    (tmp_path / "2026-01-01-grid-01").mkdir()
    (tmp_path / "2026-01-01-grid-01" / JOURNAL_NAME).write_text("damaged\n", encoding="utf-8")
    request = WritingRequest("子", tmp_path / "rig.toml", tmp_path / "out", tmp_path, practice=True)
    with pytest.raises(ConfigError, match="Put a fresh sheet in"):
        Writing(request).run()
    assert commands.ran == []


# On the loopback rig


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_character_is_written_twice_and_compared(tmp_path: Path) -> None:
    out, sessions = tmp_path / "written", tmp_path / "sessions"
    write = ("write", "子", "--config", tmp_path / "rig.toml", "--out", out, "--sessions", sessions)
    write = (*write, "--no-tui", "--cell-mm", "48", "--repeats")
    with simulate(tmp_path):
        said(*write, "2")
    [session] = sessions.iterdir()
    assert [stroke.stroke_id for stroke in Recording(session).stroke_records()] == ["子-r01", "子-r02"]

    record = WrittenRecord.read(out)
    assert record.source == "loopback rig"
    binary = [row for row in record.table_3 if (row.tone, row.polarity) == ("binary", "ink = 1")]
    rows = {(row.pair, row.alignment): row for row in binary}
    assert rows[REFERENCE, "mm"].csim.n == 2
    assert rows[PLANNED, "mm"].csim.avg > 95.0
    # The brush writes nearly the same twice; that it does not write what the uncalibrated model thinks is a finding.
    assert rows[ANOTHER, "mm"].csim.avg > 93.0
    assert 55.0 < rows[SIMULATED, "size-normalised"].csim.avg < 99.9
    page = (out / "written.html").read_text(encoding="utf-8")
    assert '<span class="source">loopback rig</span>' in page
    assert (out / "figure-13.png").stat().st_size > 10_000

    # Done is done, and what was planned stays: another count is another plan.
    assert "brushloop collect" not in said(*write, "2")
    assert "repeats: plans 2 writings, not 3: use another --out" in refused(*write, "3")

    # A session is compared with the plan that it was drawn from, and with no other.
    plan = tmp_path / "plan"
    said("write", "plan", "--out", plan, "--steps", "1", "--cell-mm", "48", "子")
    assert "'子' was not written from this plan" in refused("write", "compare", session, "--plan", plan)
