"""What the demo does in which order, after a collection that left strokes out, and after a kill; no rig."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.calibrate.commands import ValidateRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate import command
from brushloop.calibrate.validate.command import ValidationOutput
from brushloop.collect.chains import demo
from brushloop.collect.chains.demo import FULL, LEFT_OUT_CODE, QUICK, Demo, Size
from brushloop.collect.chains.loop import LoopRequest
from brushloop.collect.chains.writing import WritingRequest
from brushloop.collect.errors import CollectAborted
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import Collected, CollectRequest
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from tests.sessions.conftest import Make

RIG = rig_toml(SimConfig(), Addresses("127.0.0.1", 30004, 30010, 8080, 28700, "/dev/ttyUSB0"))


class Chain:
    """Stands for rig and commands: notes them; `collect` makes a finished session, the others their reports."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.left_out = 0
        self.validate_fails = False

    def collected(self, request: CollectRequest) -> Collected:
        self.ran.append("collect")
        rig = load_rig(request.config)
        session_id = f"grid-{1 + len(list(request.out.glob('*')))}"
        known = {"brush": rig.brush.name, "ink": rig.ink.name, "paper": rig.paper.name}
        protocol = load_protocol(request.protocol).model_dump_json()
        folder = request.out / session_id
        Make().session(folder, closed=True, session_id=session_id, protocol=protocol, **known)
        return Collected(folder, self.left_out)

    def validated(self, request: ValidateRequest, _progress: object) -> ValidationOutput:
        self.ran.append("validate")
        if self.validate_fails:
            raise CalibrationError(request.places[0], "cannot be validated")
        report = Path(request.places[0]) / "validation" / "report.html"
        report.parent.mkdir()
        report.write_text("report")
        return ValidationOutput(report.parent)

    def loop(self, request: LoopRequest) -> None:
        self.ran.append(f"loop {request.presses}")
        request.out.mkdir()
        (request.out / "loop.html").touch()

    def rig(self, what: str) -> None:
        self.ran.append(what)


class FakeRig:
    """Stands for the rig's process."""

    def __init__(self, chain: Chain, folder: Path) -> None:
        self.config = folder / "rig.toml"
        self.config.write_text(RIG)
        self.start = lambda: chain.rig("rig starts")
        self.ready = lambda: chain.rig("rig")
        self.fresh_sheet = lambda: chain.rig("fresh sheet")
        self.end = lambda: None


class FakeWriting:
    """Stands for `brushloop write`."""

    def __init__(self, chain: Chain, request: WritingRequest) -> None:
        self._chain = chain
        self._request = request

    def run(self) -> None:
        self._chain.ran.append(f"write {self._request.what} {self._request.count}")
        self._request.out.mkdir()
        (self._request.out / "written.html").touch()


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Chain:
    made = Chain()
    monkeypatch.setattr(demo, "collected", made.collected)
    monkeypatch.setattr(command, "validate", made.validated)
    monkeypatch.setattr(demo, "calibrated", lambda _session: made.ran.append("calibrate"))
    monkeypatch.setattr(demo, "fitted", lambda _session: made.ran.append("fit"))
    monkeypatch.setattr(demo, "run_loop", made.loop)
    monkeypatch.setattr(demo, "DemoRig", lambda folder, **_: FakeRig(made, folder))
    monkeypatch.setattr(demo, "Writing", lambda request: FakeWriting(made, request))
    return made


EVALUATED = ["calibrate", "fit", "rig", "fresh sheet", "loop 6", "validate"]


def run(folder: Path, size: Size = QUICK) -> int:
    return Demo(folder, size, 1, 20.0, 1, Path("paper")).run()


def test_strokes_that_were_left_out_end_in_a_report_and_exit_code_3(chain: Chain, tmp_path: Path) -> None:
    chain.left_out = 2
    assert run(tmp_path) == LEFT_OUT_CODE == 3
    assert chain.ran == ["rig", "collect", *EVALUATED]
    assert (tmp_path / "sessions" / "grid-1" / "validation" / "report.html").is_file()


def test_a_demo_that_ended_after_its_collection_goes_on_there_and_begins_no_new_session(
    chain: Chain, tmp_path: Path
) -> None:
    chain.validate_fails = True
    with pytest.raises(CalibrationError, match="cannot be validated"):
        run(tmp_path)
    chain.validate_fails = False
    chain.ran.clear()
    assert run(tmp_path) == 0
    # The presses that were made again are there: no rig, and no sheet, is needed.
    assert chain.ran == ["calibrate", "fit", "validate"]
    chain.ran.clear()
    assert run(tmp_path) == 0
    assert chain.ran == ["rig starts", "collect", *EVALUATED]
    assert sorted(path.name for path in (tmp_path / "sessions").iterdir()) == ["grid-1", "grid-2"]


def test_the_full_demo_also_writes_and_says_what_it_does(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, FULL) == 0
    again = ["calibrate", "fit", "rig", "fresh sheet", "loop 15"]
    assert chain.ran == ["rig", "collect", *again, "rig", "fresh sheet", "write 字 4", "validate"]
    said = capsys.readouterr().out
    assert "all simulated: 5 steps" in said
    for step in ("press 15 times", "fit the brush", "recover 15 presses", "write 字 4 times", "every stroke"):
        assert step in said


def test_the_command_passes_on_what_was_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[tuple[object, ...]] = []

    class Noted:
        def __init__(self, *given: object) -> None:
            asked.append(given)

        def run(self) -> int:
            return LEFT_OUT_CODE

    monkeypatch.setattr(demo, "Demo", Noted)
    words = ["demo", "--out", str(tmp_path), "--full", "--repeats", "1", "--seed", "5", "--brush", "loopback"]
    assert CliRunner().invoke(brushloop.__main__.app, words).exit_code == LEFT_OUT_CODE
    assert asked == [(tmp_path, FULL, 1, 60.0, 5, Path("loopback"))]


def test_the_sheet_is_not_changed_under_a_session_that_has_begun(chain: Chain, tmp_path: Path) -> None:
    def killed(request: LoopRequest) -> None:
        chain.ran.append("loop is killed")
        Make().store(tmp_path / "sessions" / "replay-1", session_id="replay-1").release()
        raise CollectAborted("the power failed")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(demo, "run_loop", killed)
        with pytest.raises(CollectAborted):
            run(tmp_path)
    chain.ran.clear()
    assert run(tmp_path) == 0
    assert chain.ran == ["calibrate", "fit", "rig", "loop 6", "validate"]
