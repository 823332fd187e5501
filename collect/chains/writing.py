"""Plan characters, write them on the rig, calibrate, compare; before that, learn from a few writings, if asked.

What a stage has finished is kept on disk and found again. Every round is an ordinary session of `brushloop collect`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibrate.artefact import artefacts
from collect.chains.commands import GIVEN_UP, Say, run_command
from collect.chains.finished import finished_session
from collect.errors import ConfigError
from collect.protocols.config import WriteConfig
from collect.protocols.files import load_protocol
from collect.rig.config import load_rig

PROTOCOL, PAGE = "protocol-write.toml", "written.html"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asked for."""

    what: str
    config: Path
    out: Path
    sessions: Path
    """Folder that holds sessions."""
    count: int = 10
    learn: int = 0
    """Rounds of writing a few and correcting the plan by them, before the writings that count."""
    learn_count: int = 2
    """Writings of each character in such a round."""
    sheet: int | None = None
    """The operator's word for the sheet that is in: good for one collection, as the next needs a fresh sheet."""
    plan_options: tuple[str, ...] = ()
    """Passed to `brushloop write plan` as they are."""
    references: tuple[str, ...] = ()
    collect_options: tuple[str, ...] = ()
    """Passed to `brushloop collect` as they are: `--arm`, `--no-tui`."""


class Writing:
    """One run of the chain in this process."""

    def __init__(self, wanted: Wanted, say: Say) -> None:
        self._wanted = wanted
        self._say = say
        self._sheet = wanted.sheet

    def run(self) -> Path:
        """What is not done yet; returns the report's path.

        Raises `ConfigError`, `SessionError`, `CommandFailed`.
        """
        wanted = self._wanted
        plan = self._first_plan()
        for number in range(1, wanted.learn + 1):
            plan = self._learn(plan, number)
        _check_plan(plan / PROTOCOL, wanted, wanted.count)
        session = self._written(plan / PROTOCOL)
        references = [word for given in wanted.references for word in ("--reference", given)]
        self._do("write", "compare", session, "--plan", plan, "--out", wanted.out, *references)
        return wanted.out / PAGE

    def _first_plan(self) -> Path:
        wanted, plan = self._wanted, self._wanted.out / "plan"
        if not (plan / PROTOCOL).exists():
            brush = load_rig(wanted.config).brush
            options = ["--radius-mm", str(brush.radius_mm), "--length-mm", str(brush.length_mm)]
            options += ["--repeats", str(self._repeats(1)), *wanted.plan_options]
            self._do("write", "plan", "--out", plan, *options, "--", wanted.what)
        return plan

    def _learn(self, plan: Path, number: int) -> Path:
        """The plan of the next round."""
        after = self._wanted.out / f"plan-{number}"
        if not (after / PROTOCOL).exists():
            _check_plan(plan / PROTOCOL, self._wanted, self._repeats(number))
            session = self._written(plan / PROTOCOL)
            self._do("write", "compare", session, "--plan", plan, "--out", self._wanted.out / f"round-{number}")
            options = ("--out", after, "--repeats", str(self._repeats(number + 1)))
            self._do("write", "learn", session, "--plan", plan, *options)
        return after

    def _repeats(self, number: int) -> int:
        """How often each is written in that round, from 1; the last is the one that counts."""
        return self._wanted.count if number > self._wanted.learn else self._wanted.learn_count

    def _written(self, protocol: Path) -> Path:
        """The finished, calibrated session of a plan."""
        wanted = self._wanted
        session = finished_session(wanted.sessions, protocol)
        if session is None:
            options = ["--config", str(wanted.config), "--protocol", str(protocol), "--out", str(wanted.sessions)]
            options += [] if self._sheet is None else ["--sheet", str(self._sheet)]
            self._sheet = None  # what the operator said is used up: the next session asks again
            self._do("collect", *options, *wanted.collect_options, accepts=(0, GIVEN_UP))
            session = finished_session(wanted.sessions, protocol)
        if session is None:
            raise ConfigError(wanted.sessions, "", "holds no finished session of the plan, though collection ended")
        if not artefacts(session):
            self._do("calibrate", session)
        return session

    def _do(self, *arguments: str | Path, accepts: tuple[int, ...] = (0,)) -> None:
        run_command(self._say, *arguments, accepts=accepts)


def _check_plan(path: Path, wanted: Wanted, repeats: int) -> None:
    """A plan that is there already must be of what is asked for now."""
    plan = load_protocol(path)
    assert isinstance(plan, WriteConfig)
    names = "".join(figure.name for figure in plan.figures)
    if not wanted.what.lower().endswith((".csv", ".json")) and names != wanted.what:
        raise ConfigError(path, "figures", f"plans {names}, not {wanted.what}: use another --out")
    if plan.repeats != repeats:
        raise ConfigError(path, "repeats", f"plans {plan.repeats} writings, not {repeats}: use another --out")
