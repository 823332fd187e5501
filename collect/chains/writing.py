"""Stages of `brushloop write 字`: plan, write on the rig, calibrate, compare; optionally, learn first.

With practice, a sheet of practice strokes is written before the plan, which then knows how this brush is dragged.
Results of finished stages stay on disk and are reused. Every round is an ordinary session of `brushloop collect`.
"""

from __future__ import annotations

from pathlib import Path

from brushloop.calibrate.artefact import current
from brushloop.calibrate.commands import (
    PROTOCOL,
    CompareWrittenRequest,
    FitFootprintRequest,
    LearnRequest,
    PlanRequest,
    PracticeRequest,
    show_work,
)
from brushloop.collect.chains import WritingRequest
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.open_or_resume import check_fresh_sheet
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import collected_session, finished_session
from brushloop.sessions.terminal import say

PAGE = "written.html"
FOOTPRINT = "footprint"
"""Folder of a session that holds the footprints fitted to it."""


class Writing:
    """One run of the chain in this process."""

    def __init__(self, request: WritingRequest) -> None:
        self._request = request
        self._sheet = request.sheet

    def run(self) -> Path:
        """Run what is not done yet; return the report's path.

        Raises `ConfigError`, `CalibrationError`, `SessionError`, `CollectAborted`.
        """
        request = self._request
        plan = self._first_plan()

        from brushloop.calibrate.writing import load_plan  # slow to import

        for number in range(1, request.learn + 1):
            plan = self._learn(plan, number)
            if all(figure.settled for figure in load_plan(plan).figures):
                say("The last round improved no character. Next, the best plans are written.")
                break
        session = self._written(plan, request.repeats)
        return self._compare(session, plan, request.out)

    def _first_plan(self) -> Path:
        request, plan = self._request, self._request.out / "plan"
        if (plan / PROTOCOL).exists():
            return plan
        if not (request.out / "practice" / PROTOCOL).exists():
            check_fresh_sheet(request.sessions, request.sheet)  # now, not after planning
        brush = load_rig(request.config).brush

        from brushloop.calibrate.writing import plan as write_plan  # slow to import

        wanted = PlanRequest(
            request.what,
            plan,
            data=request.data,
            radius_mm=brush.radius_mm,
            length_mm=brush.length_mm,
            footprint=self._footprint() if request.practice else None,
            cell_mm=request.cell_mm,
            repeats=self._repeats(1),
        )
        say(f"write plan {request.what} --out {plan}")
        show_work(write_plan, wanted)
        return plan

    def _footprint(self) -> Path:
        """Write the practice sheet and fit the footprint of the brush to it, if that is not done; return its file."""
        from brushloop.calibrate.writing import learn  # slow to import

        folder = self._request.out / "practice"
        if not (folder / PROTOCOL).exists():
            brush = load_rig(self._request.config).brush
            say(f"write practice --out {folder}")
            show_work(learn.practice, PracticeRequest(folder, brush.radius_mm, brush.length_mm))
        session = self._collected(folder / PROTOCOL)
        footprint = current(session, FOOTPRINT)
        if footprint is None:
            say(f"write fit {session}")
            footprint = show_work(learn.fit, FitFootprintRequest(session)).path
        return footprint

    def _learn(self, plan: Path, number: int) -> Path:
        """Write one round and learn from it; return the folder of the next plan."""
        after = self._request.out / f"plan-{number}"
        if (after / PROTOCOL).exists():
            return after
        session = self._written(plan, self._repeats(number))
        self._compare(session, plan, self._request.out / f"round-{number}")

        from brushloop.calibrate.writing import learn  # slow to import

        say(f"write learn {session} --plan {plan} --out {after}")
        repeats, settled = self._repeats(number + 1), self._request.repeats
        show_work(learn.learn, LearnRequest(session, plan, after, repeats=repeats, settled_repeats=settled))
        return after

    def _repeats(self, number: int) -> int:
        """How often each character is written in round `number`, from 1; the last round is the one that counts."""
        return self._request.repeats if number > self._request.learn else self._request.learn_repeats

    def _written(self, plan: Path, repeats: int) -> Path:
        """The session of a plan. Raises `ConfigError` if the plan is for other characters or another count."""
        path, what = plan / PROTOCOL, self._request.what
        protocol = load_protocol(path)
        assert isinstance(protocol, WriteConfig)
        names = "".join(figure.name for figure in protocol.figures)
        if names != what:
            raise ConfigError(path, "figures", f"is a plan for {names}, not for {what}: use another --out")
        if protocol.repeats != repeats:
            raise ConfigError(path, "repeats", f"plans {protocol.repeats} writings, not {repeats}: use another --out")
        return self._collected(path)

    def _collected(self, protocol: Path) -> Path:
        """The finished and calibrated session of a protocol."""
        request, sheet = self._request, None
        if self._sheet is not None and finished_session(request.sessions, request.config, protocol) is None:
            sheet, self._sheet = self._sheet, None  # used up: the next session asks again
        wanted = CollectRequest(
            request.config, protocol, request.sessions, sheet=sheet, armed=request.armed, on_screen=request.tui
        )
        return collected_session(wanted)

    def _compare(self, session: Path, plan: Path, out: Path) -> Path:
        from brushloop.calibrate.writing import compare  # slow to import

        line = f"brushloop write compare {session} --plan {plan} --out {out}"
        say(f"$ {line}")
        return show_work(compare.compare, CompareWrittenRequest(session, plan, out, line)).path


def write(request: WritingRequest) -> None:
    """Run the chain, as `Writing.run` does."""
    Writing(request).run()
