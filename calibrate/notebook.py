"""What one types in a notebook: a session and its presses, predictions, and the commands as functions.

`import brushloop` gives these names. Each function fills the request of the command of the same name and runs it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.calibrated import Calibrated, CalibrateRequest
from brushloop.calibrate.calibrated import calibrate_session as calibrate
from brushloop.calibrate.compare.place import KEYS, Alignment, Field, Tone, brush_of, simulated
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.export import FORCES, POSES, SAMPLE_COLUMNS, Series, samples, verdicts
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.calibrate.fit.brush import BrushFit, FitRequest, FitResult, fit_presses
from brushloop.calibrate.presses import Refused, crop, read_presses
from brushloop.calibrate.remote import local_path
from brushloop.calibrate.session import Calibration, OpenSession, open_session
from brushloop.calibrate.validate.command import Request, ValidationOutput, check
from brushloop.calibrate.validate.command import validate as run_validation
from brushloop.model.ccdbsm import Brush
from brushloop.model.similarity import csim, ssim
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Condition, Header

if TYPE_CHECKING:
    from brushloop.calibrate.invert import Recovered
    from brushloop.model.strokes import StrokeModel

Gray = NDArray[np.uint8]
Floats = NDArray[np.float64]
GENERATOR = "ccd-bsmg"
"""The generator that comes with brushloop."""


class Poses(NamedTuple):
    """Where the brush tip was during a press, in the base frame of the arm."""

    t_ns: NDArray[np.int64]
    """(n,) when the host received each sample."""
    position_mm: Floats
    """(n, 3)."""
    quaternion: Floats
    """(n, 4): x, y, z, w."""


class Forces(NamedTuple):
    """What the force sensor measured during a press, in its own frame; empty if the rig had none."""

    t_ns: NDArray[np.int64]
    """(n,)."""
    wrench: Floats
    """(n, 6): fx, fy, fz in N, mx, my, mz in N m."""


class RecordedPress:
    """A press of a session; a picture is decoded when it is first asked for."""

    def __init__(self, session: Session, capture: Capture) -> None:
        self._session, self._capture = session, capture

    @property
    def name(self) -> str:
        """Its name in the session, such as `H13-a05-r02`."""
        return self._capture.stroke.stroke_id

    @property
    def condition(self) -> Condition:
        """What was commanded. Raises `CalibrationError` for an import that does not say it."""
        stroke = self._capture.stroke
        if stroke.depth_mm is None or stroke.tilt_deg is None:
            raise CalibrationError(self._capture.where, "has no depth or tilt")
        return Condition(depth_mm=stroke.depth_mm, tilt_deg=stroke.tilt_deg, heading_deg=stroke.heading_deg)

    @property
    def reached_mm(self) -> float | None:
        """Depth that the arm reached; None where the recording does not say it."""
        return self._capture.stroke.reached_mm

    @property
    def verdict(self) -> str:
        """`passed` or `failed: ...` by the checks of the run, `was marked bad` by a person, or empty."""
        return self._capture.bad or self._session.verdicts.get(self.name, "")

    @cached_property
    def photograph(self) -> Gray:
        """(h, w) uint8, as it was taken."""
        return self._capture.image()

    @property
    def image(self) -> Gray:
        """(h, w) uint8: what surrounds the press, seen from above at 20 px/mm. Raises `CaptureRefused`."""
        return self._crop[0]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w), of the same shape: True where the ink is. Raises `CaptureRefused` where none is found."""
        return self._crop[1]

    @cached_property
    def coverage(self) -> NDArray[np.float32]:
        """(128, 128) share of each pixel that is ink, on the field that `predict` draws on. Raises `CaptureRefused`."""
        refused: list[Refused] = []
        for press in read_presses(self._session.opened, Field(), refused, chosen={self.name}):
            return press.coverage
        raise CaptureRefused(*refused[0])

    @property
    def poses(self) -> Poses:
        """Path of the brush tip; empty for an import."""
        t_ns, values = self._session.samples_of(POSES, self.name)
        return Poses(t_ns, values[:, :3], values[:, 3:])

    @property
    def forces(self) -> Forces:
        """Force during the press."""
        return Forces(*self._session.samples_of(FORCES, self.name))

    @cached_property
    def _crop(self) -> tuple[Gray, NDArray[np.bool_]]:
        return crop(self._capture, self._session.opened.calibration)[:2]


class Session:
    """A finished session: a folder, an MCAP file, or a URL with a checksum.

    Raises `SessionError`, and `CalibrationError` for a URL that cannot be read.
    """

    def __init__(self, place: str | os.PathLike[str]) -> None:
        self.recording = Recording(local_path(str(place)))

    @property
    def header(self) -> Header:
        """Where the strokes come from: source, devices, brush, ink, paper, protocol."""
        return self.recording.header

    @property
    def brush(self) -> Brush:
        """The brush by its nominal size."""
        return brush_of(self.header)

    @property
    def calibration(self) -> Calibration | None:
        """The calibration in use; None if there is none, as for an import."""
        path = current(self.recording.path.parent)
        return None if path is None else load_artefact(path, Calibration)

    @property
    def fit(self) -> BrushFit | None:
        """The brush fit in use."""
        path = current(self.recording.path.parent, FITS)
        return None if path is None else load_artefact(path, BrushFit)

    @cached_property
    def opened(self) -> OpenSession:
        """The session with the calibration that crops use. Raises `CalibrationError` where it is missing."""
        return open_session(self.recording.path)

    @cached_property
    def verdicts(self) -> dict[str, str]:
        """Result of the checks of the run by name of stroke."""
        return verdicts(self.recording)

    def presses(self) -> Iterator[RecordedPress]:
        """Every press in order, those that were marked bad included."""
        return (RecordedPress(self, capture) for capture in self.recording.captures())

    def samples_of(self, series: Series, stroke: str) -> tuple[NDArray[np.int64], Floats]:
        """Times (n,) and values (n, width) of what was sampled during the press of a stroke."""
        if series not in self._samples:
            self._samples[series] = samples(self.recording, series)
        when, values = self._samples[series]
        episode, t_ns = (when[:, SAMPLE_COLUMNS.index(name)] for name in ("episode_index", "t_ns"))
        its_own = episode == self._numbers[stroke]
        return t_ns[its_own], values[its_own]

    @cached_property
    def _samples(self) -> dict[Series, tuple[NDArray[np.int64], Floats]]:
        return {}

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {stroke.stroke_id: number for number, stroke in enumerate(self.recording.stroke_records())}


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The mark that a model predicts for a press."""

    model: str
    image: NDArray[np.float32]
    """(128, 128) share of each pixel that is ink, at .3 mm/px, with the zero-touch point at .76 of the width."""
    outline_mm: Floats
    """(n, 2) points along its edge, from where the brush axis meets the paper; the ferrule leans toward positive x."""

    def _repr_html_(self) -> str:
        points = " ".join(f"{x:.2f},{-y:.2f}" for x, y in self.outline_mm)
        return f'<svg viewBox="-40 -20 60 40" width="360"><polygon points="{points}"/></svg>'


def models() -> tuple[str, ...]:
    """Names of the models that `predict` draws."""
    from brushloop.model.strokes import stroke_models

    return (*stroke_models(Brush()), GENERATOR)


def predict(condition: Condition, brush: Brush | BrushFit | None = None, model: str = "ccd-bsm") -> Prediction:
    """Draw a press; a fitted brush draws itself, whatever the model, and None is the published brush.

    Raises `UnknownModelError`, and `DomainError` for a press that the model does not predict.
    """
    chosen = _model(brush or Brush(), model)
    images = simulated(chosen, condition.depth_mm, condition.tilt_deg, Field())
    image = np.asarray(images[KEYS.index((Alignment.MM, Tone.GRAY))] / 255.0, np.float32)
    edge = chosen.profile(condition.depth_mm, condition.tilt_deg).polyline()[0]
    return Prediction(chosen.name, image, edge)


def _model(brush: Brush | BrushFit, name: str) -> StrokeModel:
    if isinstance(brush, BrushFit):
        from brushloop.model.fitted import fitted_model

        return fitted_model(brush.press())
    if name == GENERATOR:
        from brushloop.model.generator import SHIPPED_GENERATOR
        from brushloop.model.generator.stroke import load_generator

        return load_generator(SHIPPED_GENERATOR, brush)
    from brushloop.model.strokes import stroke_model

    return stroke_model(name, brush)


class Similarity(NamedTuple):
    """How alike two images are, from 0 to 1."""

    csim: float
    ssim: float


def compare(one: NDArray[Any], other: NDArray[Any]) -> Similarity:
    """Compare two images of one shape with ink as 1 and paper as 0. Raises ValueError for a blank image."""
    return Similarity(csim(one, other), ssim(one, other))


Place = Session | str | os.PathLike[str]
"""A session, or what `Session` takes."""


def calibrate_session(session: Place, *, lens: Path | None = None) -> Calibrated:
    """Fit scale and paper plane of a session from the board in view, as `brushloop calibrate` does."""
    return calibrate(CalibrateRequest(_path(session), lens))


def fit(session: Place, **options: Any) -> FitResult:
    """Fit the brush to the presses of a session, as `brushloop fit` does; `options` are fields of `FitRequest`."""
    return fit_presses(FitRequest(_path(session), **options))


def recover(session: Place, out: Path | None = None, **options: Any) -> Recovered:
    """Recover depth and tilt of every press from its image, as `brushloop invert` does.

    Writes `recovered.csv` and the protocol that repeats the presses, beside the recording unless `out` says where.
    `options` are fields of `RecoverRequest`.
    """
    from brushloop.calibrate.invert import RecoverRequest
    from brushloop.calibrate.invert import recover as run

    path = _path(session)
    return run(RecoverRequest(session=path, out=out or Recording(path).path.parent / "recovered.csv", **options))


def validate(*sessions: Place, **options: Any) -> ValidationOutput:
    """Compare every model with every press, as `brushloop validate` does; `options` are fields of its `Request`.

    Raises `GateMissed` if a gate is missed, once the report is written.
    """
    places = tuple(str(one.recording.path) if isinstance(one, Session) else str(one) for one in sessions)
    request = Request(places=places, command=f"brushloop.validate{places}", **options)
    output = run_validation(request)
    check(output, request)
    return output


def _path(session: Place) -> Path:
    return session.recording.path if isinstance(session, Session) else local_path(str(session))
