"""What the demo does after a collection that left strokes out, and after one whose report was never written."""

from __future__ import annotations

from pathlib import Path

import pytest

from collect.chains import demo
from collect.chains.commands import GIVEN_UP, CommandFailed
from collect.protocols.config import load_protocol
from sessions.store import SessionStore
from tests.sessions.conftest import Make


class Chain:
    """Stands for the commands: notes them; `collect` makes a finished session, `validate` its report."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.collect_code = 0
        self.validate_fails = False

    def __call__(self, _say: object, name: str, *arguments: str | Path, accepts: tuple[int, ...] = (0,)) -> int:
        self.ran.append(name)
        if name == "collect":
            sessions, protocol = Path(arguments[5]), Path(arguments[3])
            header = Make.header.model_copy(
                update={
                    "session_id": f"grid-{1 + len(list(sessions.glob('*')))}",
                    "protocol": load_protocol(protocol).model_dump_json(),
                }
            )
            store = SessionStore.create(sessions / header.session_id, header, Make.snapshots, Make().clock())
            Make().collect(store)
            store.close()
            store.release()
            assert self.collect_code in accepts
            return self.collect_code
        if name == "validate":
            if self.validate_fails:
                raise CommandFailed([name], 1)
            report = Path(arguments[0]) / "validation" / "report.html"
            report.parent.mkdir()
            report.write_text("report")
        return 0


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Chain:
    made = Chain()
    monkeypatch.setattr(demo, "run_command", made)
    monkeypatch.setattr(demo, "_serving", lambda *_, **__: None)
    return made


ALL = ["collect", "calibrate", "fit", "validate"]


def test_strokes_that_were_left_out_end_in_a_report_and_exit_code_3(chain: Chain, tmp_path: Path) -> None:
    chain.collect_code = GIVEN_UP
    assert demo.run_demo(tmp_path, 1, 20.0, 1) == 3
    assert chain.ran == ALL
    assert (tmp_path / "sessions" / "grid-1" / "validation" / "report.html").is_file()


def test_a_demo_that_ended_after_its_collection_goes_on_there_and_begins_no_new_session(
    chain: Chain, tmp_path: Path
) -> None:
    chain.validate_fails = True
    with pytest.raises(CommandFailed, match="goes on from there"):
        demo.run_demo(tmp_path, 1, 20.0, 1)
    chain.validate_fails = False
    chain.ran.clear()
    assert demo.run_demo(tmp_path, 1, 20.0, 1) == 0
    assert chain.ran == ALL[1:]
    assert demo.run_demo(tmp_path, 1, 20.0, 1) == 0
    assert sorted(path.name for path in (tmp_path / "sessions").iterdir()) == ["grid-1", "grid-2"]
