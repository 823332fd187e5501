"""What one types in a notebook: a session and its presses, predictions, and the commands as functions.

`import brushloop` gives these names. Each function fills the request of the command of the same name and runs it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from pydantic import ValidationError

from brushloop.calibrate.commands import AnalyseRequest, CalibrateRequest, FitRequest, RecoverRequest, ValidateRequest
from brushloop.calibrate.compare import MM_GRAY, brush_of, simulated
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import Written
from brushloop.calibrate.presses import Refused, read_presses, rectified
from brushloop.calibrate.session import Calibration, OpenSession, open_session
from brushloop.calibrate.stroke.preprocess import Gray, Prepared
from brushloop.model.ccdbsm import Brush
from brushloop.model.fitted import fitted_model
from brushloop.model.generator.stroke import named_model
from brushloop.model.strokes import Prediction
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import Begin, StepEvent, StepKind
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Condition, Header, Quality, Topic, Wrench
from brushloop.sessions.terminal import Progress, unseen

if TYPE_CHECKING:
    # What only some of the functions need is imported when they are called.
    from brushloop.calibrate.calibrated import Calibrated
    from brushloop.calibrate.fit.command import BrushFit, FitResult
    from brushloop.calibrate.recover import Recovered
    from brushloop.calibrate.validate.command import ValidationOutput

SAMPLE_COLUMNS = ("episode_index", "frame_index", "t_ns", "log_ns", "sequence")
"""Numbers of the stroke and of the sample within it; times at the device and the recorder; the sample's own number."""


class RecordedPress:
    """A press of a session; a picture is decoded when it is first asked for."""

    def __init__(self, session: Session, capture: Capture, number: int) -> None:
        self.capture = capture
        self._session, self._number = session, number

    @property
    def name(self) -> str:
        """Its name in the session, such as `H13-a05-r02`."""
        return self.capture.stroke.stroke_id

    @property
    def condition(self) -> Condition:
        """What was commanded. Raises `CalibrationError` for an import that does not say it."""
        stroke = self.capture.stroke
        if stroke.depth_mm is None or stroke.tilt_deg is None:
            raise CalibrationError(self.capture.where, "has no depth or tilt")
        return Condition(depth_mm=stroke.depth_mm, tilt_deg=stroke.tilt_deg, heading_deg=stroke.heading_deg)

    @property
    def reached_mm(self) -> float | None:
        """Depth that the arm reached; None where the recording does not say it."""
        return self.capture.stroke.reached_mm

    @property
    def verdict(self) -> str:
        """`passed` or `failed: ...` by the checks of the run, `was marked bad` by a person, or empty."""
        return self.capture.bad or self._session.verdicts.get(self.name, "")

    @cached_property
    def photograph(self) -> Gray:
        """(h, w) uint8, as it was taken."""
        return self.capture.image()

    @cached_property
    def crop(self) -> tuple[Gray, NDArray[np.bool_], Prepared]:
        """`image`, `mask`, and what else was found in them. Raises `CaptureRefused`.

        The ink of a press is its largest connected ink; that of a stroke that travels is all in its patch.
        """
        raster, prepared = rectified(self.capture, self._session.calibration)
        return raster, prepared.ink if self.capture.stroke.kind == "drag" else prepared.mask, prepared

    @property
    def image(self) -> Gray:
        """(h, w) uint8: what surrounds the press, seen from above at 20 px/mm. Raises `CaptureRefused`."""
        return self.crop[0]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(h, w), of the same shape: True where the ink is. Raises `CaptureRefused` where none is found."""
        return self.crop[1]

    @cached_property
    def coverage(self) -> NDArray[np.float32]:
        """(128, 128) share of each pixel that is ink, on the field that `predict` draws on. Raises `CaptureRefused`."""
        refused: list[Refused] = []
        for press in read_presses(self._session.opened, refused, chosen={self.name}):
            return press.coverage
        raise CaptureRefused(*refused[0])

    @property
    def poses(self) -> NDArray[np.void]:
        """Path of the brush tip: the rows of `Session.poses` that belong to this press; none for an import."""
        return self._own(self._session.poses)

    @property
    def forces(self) -> NDArray[np.void]:
        """Force during the press: its rows of `Session.forces`; none if the rig had no sensor."""
        return self._own(self._session.forces)

    def _own(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        return samples[samples["episode_index"] == self._number]


class Session:
    """A finished session: its folder or MCAP file. Raises `SessionError`."""

    def __init__(self, place: str | os.PathLike[str]) -> None:
        self.recording = Recording(Path(place))

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
        """The calibration in use; None for an import. Raises `CalibrationError` where it is missing."""
        return self.opened.calibration

    @cached_property
    def opened(self) -> OpenSession:
        """The session as calculations read it. Raises `CalibrationError` where its calibration is missing."""
        return open_session(self.recording.path)

    @cached_property
    def verdicts(self) -> dict[str, str]:
        """Result of the checks of the run, `passed` or `failed: ...`, by name of stroke."""
        return {judged.stroke_id: judged.verdict for judged in self.recording.events(Topic.QUALITY, Quality)}

    def presses(self) -> Iterator[RecordedPress]:
        """Every press in order, those that were marked bad included."""
        return (RecordedPress(self, capture, k) for k, capture in enumerate(self.recording.captures()))

    @cached_property
    def poses(self) -> NDArray[np.void]:
        """(n,) poses of the brush tip during all presses, in the robot's base frame: mm and a unit quaternion.

        The fields are `SAMPLE_COLUMNS` and those of the value. Raises `SessionDamaged`.
        """
        return self._sampled(Topic.TCP, ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"), _pose)

    @cached_property
    def forces(self) -> NDArray[np.void]:
        """(n,) forces during all presses, in the sensor's own frame: N and N m, with fields as `poses` has them."""
        return self._sampled(Topic.WRENCH, tuple(Wrench.model_fields), _wrench)

    def _sampled(
        self, topic: Topic, columns: tuple[str, ...], values_of: Callable[[bytes], tuple[float, ...]]
    ) -> NDArray[np.void]:
        numbers = {stroke.stroke_id: number for number, stroke in enumerate(self.recording.stroke_records())}
        rows: list[tuple[float, ...]] = []
        current, frame, on = -1, 0, topic
        try:
            for _schema, channel, message in self.recording.messages(Topic.STEP, topic):
                on = channel.topic
                if on == Topic.STEP:
                    step = StepEvent.model_validate_json(message.data).step
                    pressed = step.press if isinstance(step, Begin) and step.kind != StepKind.CAPTURE else None
                    current, frame = -1 if pressed is None else numbers.get(pressed.stroke_id, -1), 0
                elif current >= 0:
                    times = message.publish_time, message.log_time, message.sequence
                    rows.append((current, frame, *times, *values_of(message.data)))
                    frame += 1
        except (ValidationError, DecodeError):
            raise SessionDamaged(self.recording.path, f"a message on {on} does not fit its schema") from None
        fields = [(name, np.int64) for name in SAMPLE_COLUMNS] + [(name, np.float64) for name in columns]
        return np.array(rows, np.dtype(fields))


def _pose(data: bytes) -> tuple[float, ...]:
    pose = PoseInFrame.FromString(data).pose
    at, turned = pose.position, pose.orientation
    return at.x * 1e3, at.y * 1e3, at.z * 1e3, turned.x, turned.y, turned.z, turned.w


def _wrench(data: bytes) -> tuple[float, ...]:
    return tuple(Wrench.model_validate_json(data).model_dump().values())


def predict(condition: Condition, brush: Brush | BrushFit | None = None, model: str = "ccd-bsm") -> Prediction:
    """Draw a press; a fitted brush draws itself, whatever the model, and None is the published brush.

    Raises `UnknownModelError`, and `DomainError` for a press that the model does not predict.
    """
    chosen = brush or Brush()
    drawn = named_model(model, chosen) if isinstance(chosen, Brush) else fitted_model(chosen.press())
    images = simulated(drawn, condition.depth_mm, condition.tilt_deg)
    image = np.asarray(images[MM_GRAY] / 255.0, np.float32)
    edge = drawn.profile(condition.depth_mm, condition.tilt_deg).polyline()[0]
    return Prediction(drawn.name, image, edge)


Place = Session | str | os.PathLike[str]
"""A session, or what `Session` takes."""


def calibrate_session(session: Place, *, lens: Path | None = None) -> Calibrated:
    """Fit scale and paper plane of a session from the board in view, as `brushloop calibrate` does."""
    from brushloop.calibrate import calibrated

    return calibrated.calibrate_session(CalibrateRequest(_path(session), lens))


def fit(session: Place, **options: Any) -> FitResult:
    """Fit the brush to the presses of a session, as `brushloop fit` does; `options` are fields of `FitRequest`."""
    from brushloop.calibrate.fit.command import fit_press_session

    return fit_press_session(FitRequest(_path(session), **options))


def recover(session: Place, out: Path | None = None, **options: Any) -> Recovered:
    """Recover depth and tilt of every press from its image, as `brushloop recover` does.

    Writes `recovered.csv` and the protocol that repeats the presses, beside the recording unless `out` says where.
    `options` are fields of `RecoverRequest`.
    """
    from brushloop.calibrate.recover import recover as run

    path = _path(session)
    return run(RecoverRequest(path, out or path.parent / "recovered.csv", **options))


def validate(*sessions: Place, **options: Any) -> ValidationOutput:
    """Compare every model with every press, as `brushloop validate` does; `options` are fields of `ValidateRequest`.

    Raises `GateMissed` if a gate is missed, once the report is written.
    """
    from brushloop.calibrate.validate import command

    paths = tuple(_path(session) for session in sessions)
    words = ", ".join(repr(str(path)) for path in paths)
    output = command.validate(ValidateRequest(paths, command=f"brushloop.validate({words})", **options))
    output.check()
    return output


def analyse(request: AnalyseRequest, progress: Progress = unseen) -> Written:
    """Calibrate, fit and validate one session, from photographs to the verdict. Raises as each of these does.

    An import has its own scale and is not calibrated.
    """
    from brushloop.calibrate import calibrated
    from brushloop.calibrate.fit.command import fit as fit_strokes
    from brushloop.calibrate.validate.command import validate as compare_models

    session, recording, said = request.session, Recording(request.session), list[object]()
    if not recording.header.source.imported:
        said += calibrated.calibrate_session(CalibrateRequest(session), progress, recording).lines()
    fitted = fit_strokes(FitRequest(session), progress, recording)
    validated = compare_models(ValidateRequest((session,)), progress, [recording])
    left_out = max(fitted.left_out, validated.left_out, key=len)
    return Written(validated.page, (*said, *fitted.lines(), *validated.lines()), left_out)


def _path(session: Place) -> Path:
    return (session if isinstance(session, Session) else Session(session)).recording.path
