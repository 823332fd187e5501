"""Stages of `brushloop write 字`: plan, write on the rig, calibrate, compare; optionally, learn first.

With practice, a sheet of practice strokes is written before the plan, which then knows how this brush is dragged.
Results of finished stages stay on disk and are reused. Every round is an ordinary session of `brushloop collect`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.artefact import current
from brushloop.calibrate.writing.plan_record import PROTOCOL, load_plan
from brushloop.collect.chains.commands import Say, collected_session, finished_session, run_command
from brushloop.collect.engine.open_or_resume import check_fresh_sheet
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.write import WriteConfig
from brushloop.collect.rig.config import load_rig

PAGE = "written.html"
FOOTPRINT = "footprint"
"""Folder of a session that holds the footprints fitted to it."""


@dataclass(frozen=True, slots=True)
class WritingRequest:
    """What the command line asked for."""

    what: str
    config: Path
    out: Path
    sessions: Path
    """Folder that holds sessions."""
    count: int = 10
    learn: int = 0
    """Rounds before the final writings; each writes a few copies and corrects the plan by them."""
    learn_count: int = 2
    """How often each character is written in such a round."""
    practice: bool = False
    """Whether a practice sheet comes first."""
    sheet: int | None = None
    """Number of the sheet that the operator has put in; valid for one collection, as the next needs a fresh sheet."""
    plan_options: tuple[str, ...] = ()
    """Passed on to `brushloop write plan`."""
    references: tuple[str, ...] = ()
    collect_options: tuple[str, ...] = ()
    """Passed on to `brushloop collect`: `--arm`, `--no-tui`."""


class Writing:
    """One run of the chain in this process."""

    def __init__(self, request: WritingRequest, say: Say) -> None:
        self._request = request
        self._say = say
        self._sheet = request.sheet

    def run(self) -> Path:
        """Run what is not done yet; return the report's path.

        Raises `ConfigError`, `CalibrationError`, `SessionError`, `CommandFailed`.
        """
        request = self._request
        plan = self._first_plan()
        for number in range(1, request.learn + 1):
            plan = self._learn(plan, number)
            if all(figure.settled for figure in load_plan(plan).figures):
                self._say("No character gained by the last round: the best plans are written.")
                break
        _check_plan(plan / PROTOCOL, request, request.count)
        session = self._written(plan / PROTOCOL)
        references = [word for given in request.references for word in ("--reference", given)]
        self._do("write", "compare", session, "--plan", plan, "--out", request.out, *references)
        return request.out / PAGE

    def _first_plan(self) -> Path:
        request, plan = self._request, self._request.out / "plan"
        if not (plan / PROTOCOL).exists():
            if not (request.out / "practice" / PROTOCOL).exists():
                check_fresh_sheet(request.sessions, request.sheet)  # now, not after planning
            brush = load_rig(request.config).brush
            options = ["--radius-mm", str(brush.radius_mm), "--length-mm", str(brush.length_mm)]
            options += ["--repeats", str(self._repeats(1)), *request.plan_options]
            options += ["--footprint", str(self._footprint())] if request.practice else []
            self._do("write", "plan", "--out", plan, *options, "--", request.what)
        return plan

    def _footprint(self) -> Path:
        """Write the practice sheet and fit the footprint of the brush to it, if that is not done; return its file."""
        request, folder = self._request, self._request.out / "practice"
        if not (folder / PROTOCOL).exists():
            brush = load_rig(request.config).brush
            options = ["--radius-mm", str(brush.radius_mm), "--length-mm", str(brush.length_mm)]
            self._do("write", "practice", "--out", folder, *options)
        session = self._written(folder / PROTOCOL)
        found = current(session, FOOTPRINT)
        if found is None:
            self._do("write", "fit", session)
            found = current(session, FOOTPRINT)
        if found is None:
            raise ConfigError(session, "", "holds no footprint, although `write fit` ended")
        return found

    def _learn(self, plan: Path, number: int) -> Path:
        """Write one round and learn from it; return the folder of the next plan."""
        after = self._request.out / f"plan-{number}"
        if not (after / PROTOCOL).exists():
            _check_plan(plan / PROTOCOL, self._request, self._repeats(number))
            session = self._written(plan / PROTOCOL)
            self._do("write", "compare", session, "--plan", plan, "--out", self._request.out / f"round-{number}")
            repeats = str(self._repeats(number + 1))
            options = ("--out", after, "--repeats", repeats, "--settled-repeats", str(self._request.count))
            self._do("write", "learn", session, "--plan", plan, *options)
        return after

    def _repeats(self, number: int) -> int:
        """How often each character is written in round `number`, from 1; the last round is the one that counts."""
        return self._request.count if number > self._request.learn else self._request.learn_count

    def _written(self, protocol: Path) -> Path:
        """The finished and calibrated session of a plan."""
        request, options = self._request, list(self._request.collect_options)
        if self._sheet is not None and finished_session(request.sessions, request.config, protocol) is None:
            options += ["--sheet", str(self._sheet)]
            self._sheet = None  # used up: the next session asks again
        return collected_session(self._say, request.config, protocol, request.sessions, options)

    def _do(self, *arguments: str | Path) -> None:
        run_command(self._say, *arguments)


def _check_plan(path: Path, request: WritingRequest, repeats: int) -> None:
    """Raise `ConfigError` if the plan on disk is for other characters or another count."""
    plan = load_protocol(path)
    assert isinstance(plan, WriteConfig)
    names = "".join(figure.name for figure in plan.figures)
    if not request.what.lower().endswith((".csv", ".json")) and names != request.what:
        raise ConfigError(path, "figures", f"plans {names}, not {request.what}: use another --out")
    if plan.repeats != repeats:
        raise ConfigError(path, "repeats", f"plans {plan.repeats} writings, not {repeats}: use another --out")
