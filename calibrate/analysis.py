"""`brushloop analyse SESSION`: from photographs to the verdict, as `calibrate`, `fit` and `validate` do one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from brushloop.calibrate.calibrated import Calibrated, calibrate_session
from brushloop.calibrate.commands import AnalyseRequest, CalibrateRequest, FitRequest, Printable, ValidateRequest
from brushloop.calibrate.fit.fit import fit
from brushloop.calibrate.validate.command import ValidationOutput, validate
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen


@dataclass(frozen=True, slots=True)
class Analysed:
    """What calibration, fit and validation found."""

    calibrated: Calibrated | None
    """None for an import, which has its own scale."""
    fitted: Printable
    validated: ValidationOutput

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables of each step; the report comes last."""
        for step in filter(None, (self.calibrated, self.fitted, self.validated)):
            yield from step.lines()


def analyse(request: AnalyseRequest, progress: Progress = unseen) -> Analysed:
    """Calibrate, fit and validate one session. Raises as each of these does."""
    session = request.session
    imported = Recording(session).header.source.imported
    calibrated = None if imported else calibrate_session(CalibrateRequest(session), progress)
    fitted = fit(FitRequest(session), progress)
    wanted = ValidateRequest((str(session),), generators=(SHIPPED_GENERATOR,))
    return Analysed(calibrated, fitted, validate(wanted, progress))
