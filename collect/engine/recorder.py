"""What one attempt at a step works with: what it records, and the guard on the force."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log

from brushloop.calibrate.board.pix2len import Plane, SeenBoard, see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke.preprocess import Gray
from brushloop.collect.engine.control import RunControl
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.engine.snapshot import Progress
from brushloop.collect.errors import ConfigError, ForceTooHigh, StepError, describe
from brushloop.collect.motion import Procedures
from brushloop.collect.operator import Asker
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.collect.touch.measure import used_patches as touched_patches
from brushloop.collect.walk import PlannedPose, check_poses, sheet_of
from brushloop.drivers.devices import ForceSample, Frame, PoseSample, Stamp
from brushloop.drivers.errors import DeviceError, MotionFailed
from brushloop.drivers.host import Clock, finished
from brushloop.sessions.errors import SessionError
from brushloop.sessions.mcap_writer import Outgoing, SegmentWriter
from brushloop.sessions.messages import encode_png, image_message, pose_message
from brushloop.sessions.records import Event, Topic, Wrench
from brushloop.sessions.store import Attempt, SessionStore

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from brushloop.calibrate.board.lens import Lens


CHECK_S = 0.02
"""Time between checks for a silent sensor: silence must not be mistaken for zero force."""

_R = TypeVar("_R")


class ForceGuard:
    """Passes on the force sensor's samples, and compares them with `force.max_n`; does nothing without a sensor."""

    def __init__(self, rig: Rig, *listeners: Callable[[ForceSample], None]) -> None:
        """`listeners` are called with every sample."""
        self._rig, limits = rig, rig.config.force
        self._max_n = math.inf if limits is None else limits.max_n
        self.listeners = list(listeners)
        self._over: asyncio.Event = asyncio.Event()
        self._guarding = False
        self.peak_n = 0.0
        """Largest force since `guarded` began."""

    async def guarded(self, procedure: Coroutine[Any, Any, _R]) -> _R:
        """Run the procedure while the force is watched.

        Raises `ForceTooHigh` above the ceiling, and `Stale` or `ConnectionLost` if the sensor falls silent; in each
        case the arm is stopped first. Raises `MotionFailed`, which names that cause first, if the stop fails.
        """
        if self._rig.force is None or self._guarding:
            return await procedure
        self._over.clear()
        self.peak_n, self._guarding = 0.0, True
        work, watch = asyncio.ensure_future(procedure), asyncio.create_task(self._watch(), name="force guard")
        try:
            await asyncio.wait((work, watch), return_when=asyncio.FIRST_COMPLETED)
            if watch.done():
                work.cancel()  # or it would send its next line while the arm is being stopped
                try:
                    await self._rig.robot.stop()
                except DeviceError as failure:
                    cause = str(watch.exception()).removesuffix(".")
                    raise MotionFailed(failure.device, failure.op, cause, condition=describe(failure)) from failure
                watch.result()
            return await work
        finally:
            self._guarding = False
            for task in (work, watch):
                task.cancel()
            await asyncio.gather(work, watch, return_exceptions=True)

    async def _watch(self) -> None:
        assert self._rig.force is not None
        while True:
            self._rig.force.latest()
            try:
                async with asyncio.timeout(CHECK_S):
                    await self._over.wait()
            except TimeoutError:
                continue
            raise ForceTooHigh(self.peak_n, self._max_n)

    def sample(self, sample: ForceSample) -> None:
        """Accept one sample of the sensor."""
        if self._guarding:
            self.peak_n = max(self.peak_n, math.hypot(*sample.force_n))
            if self.peak_n > self._max_n:
                self._over.set()
        for listener in self.listeners:
            listener(sample)


CLOCK_STEP_NS = 1_000_000_000
"""A sample that seems to have taken longer to arrive shows that the device's clock was set or began again."""


class Recorder:
    """Writer of one attempt, with one method for each kind of message."""

    def __init__(self, writer: SegmentWriter, clock: Clock, live: LiveView | None = None) -> None:
        """`live` shows every message to viewers as well."""
        self._writer = writer
        self._live = live
        self._clock = clock
        self.listeners: list[Callable[[PoseSample], None]] = []
        """Called with every pose."""
        self._offset_ns: int | None = None
        """Of the host's clock from the force sensor's."""

    def pose(self, sample: PoseSample) -> None:
        """Record a pose, and the joint angles if they came with it, stamped when the host received them."""
        stamp = sample.stamp
        for listener in self.listeners:
            listener(sample)
        self._sample(Topic.TCP, stamp, pose_message(stamp.host_ns, sample.pose.position_mm, sample.pose.quaternion))
        if sample.joints_rad is not None:
            joints = JointStates()
            joints.timestamp.FromNanoseconds(stamp.host_ns)
            for number, position_rad in enumerate(sample.joints_rad, start=1):
                joints.joints.add(name=f"joint{number}", position=position_rad)
            self._sample(Topic.JOINTS, stamp, joints)

    def force(self, sample: ForceSample) -> None:
        """Record a sample of the force sensor, stamped when the host received it."""
        (fx, fy, fz), (mx, my, mz) = sample.force_n, sample.torque_nm
        wrench = Wrench(fx_n=fx, fy_n=fy, fz_n=fz, mx_nm=mx, my_nm=my, mz_nm=mz)
        self._sample(Topic.WRENCH, sample.stamp, wrench)

    def paper(self, origin_mm: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> None:
        """Record where the paper's frame lies in the base frame; metres on disk, and (x, y, z, w)."""
        message, now_ns = FrameTransforms(), self._clock.now_ns()
        transform = message.transforms.add(parent_frame_id="base", child_frame_id="paper")
        transform.timestamp.FromNanoseconds(now_ns)
        there, turned = transform.translation, transform.rotation
        there.x, there.y, there.z = (v / 1e3 for v in origin_mm)
        turned.x, turned.y, turned.z, turned.w = quaternion
        self._put(Topic.TRANSFORMS, now_ns, now_ns, 0, message)

    def optics(self, used: Lens) -> None:
        """Record the lens with which photographs are undistorted before they are judged.

        The camera is single and not rectified: R is the identity, P is [K | 0].
        """
        now_ns, matrix = self._clock.now_ns(), used.camera
        message = CameraCalibration(
            frame_id="camera",
            width=used.size_px[0],
            height=used.size_px[1],
            distortion_model="plumb_bob",
            D=used.distortion,
            K=matrix.ravel().tolist(),
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[v for row in matrix.tolist() for v in [*row, 0.0]],
        )
        message.timestamp.FromNanoseconds(now_ns)
        self._put(Topic.CALIBRATION, now_ns, now_ns, 0, message)

    def still(self, frame: Frame, number: int) -> None:
        """Record a lossless still; `number` is unique in the session. Encoding takes tens of ms: call in a thread."""
        stamp = frame.stamp
        message = image_message(stamp.host_ns, encode_png(frame.image))
        self._put(Topic.STILL, self._clock.now_ns(), stamp.host_ns, number, message)

    def log(self, text: str) -> None:
        """Record a line of the log."""
        now_ns = self._clock.now_ns()
        message = Log(level=Log.INFO, message=text, name="brushloop")
        message.timestamp.FromNanoseconds(now_ns)
        self._put(Topic.LOG, now_ns, now_ns, 0, message)

    def event(self, topic: Topic, event: Event, sequence: int = 0) -> None:
        """Record what is known now; `sequence` is the number of the still that it is about, if any."""
        now_ns = self._clock.now_ns()
        self._put(topic, now_ns, now_ns, sequence, event)

    def _sample(self, topic: Topic, stamp: Stamp, message: Event | Message) -> None:
        # A failed disk must not end the telemetry that calls this; the step's next event raises the error.
        with contextlib.suppress(SessionError):
            self._put(topic, stamp.host_ns, self._taken_ns(stamp), stamp.seq, message)

    def _taken_ns(self, stamp: Stamp) -> int:
        """When the device took a sample, by the host's clock, whose offset the quickest sample so far gives."""
        if stamp.device_ns is None:
            return stamp.host_ns
        offset_ns = stamp.host_ns - stamp.device_ns
        if self._offset_ns is None or not 0 <= offset_ns - self._offset_ns < CLOCK_STEP_NS:
            self._offset_ns = offset_ns
        return stamp.device_ns + self._offset_ns

    def _put(self, topic: Topic, log_ns: int, publish_ns: int, sequence: int, message: Event | Message) -> None:
        outgoing = Outgoing(topic, log_ns, publish_ns, sequence, message)
        self._writer.write(outgoing)
        self.show(outgoing)

    def show(self, outgoing: Outgoing) -> None:
        """Show viewers a message that the file holds."""
        if self._live is not None:
            self._live.offer(outgoing)


@dataclass(slots=True)
class RunContext:
    """The rig, the session and the operator, for the length of a run, and in what state brush and view are.

    A new process knows nothing of that state.
    """

    opening: Opening
    progress: Progress
    asker: Asker
    control: RunControl = field(default_factory=RunControl)
    rig: Rig = field(init=False)
    store: SessionStore = field(init=False)
    procedures: Procedures = field(init=False)
    sheet: Sheet = field(init=False)
    board: SeenBoard = field(init=False)
    """The board, and with it the paper, where it was seen last. Set by the BOARD step that comes before the first dip
    of every process, and raises if no board is seen."""
    left_ink_ns: int | None = None
    """Host time at which the brush left the ink; None if another step came since, or it may have lost its ink."""
    sound_frame: Gray | None = None
    """Newest valid gray photograph of the current sheet."""
    looked_at_sheet: int | None = None
    """Sheet whose free patches were seen to be blank."""
    light: float | None = None
    """Light of the ink station as it was set; None without one."""

    def connected(self, rig: Rig) -> None:
        """Work with this rig from now on."""
        self.rig, self.procedures = rig, Procedures(rig)
        self.sheet = sheet_of(rig.config, self.opening.protocol)

    def used_patches(self) -> set[int]:
        """Patches of the current sheet on which any mark was started, or which zero touch may ink."""
        state, config = self.store.state, self.rig.config
        marked = {patch for sheet, patch in state.used_patches if sheet == state.sheet}
        return marked | touched_patches(self.sheet, config.paper, config.touch)

    def image_plane(self, image: Gray) -> Plane:
        """Where the paper lies in this frame: from the board in it, else from the newest frame that showed one."""
        with contextlib.suppress(CalibrationError):
            self.board = see_board(image, self.rig.config.board, self.board)
        return self.board.plane

    def fresh_sheet(self) -> None:
        """Record that a person has put a fresh sheet in."""
        self.store.fresh_sheet()
        self.sound_frame = None
        self.procedures.photographer.forget()


@dataclass(frozen=True, slots=True)
class StepContext:
    """One attempt at one step."""

    run: RunContext
    patches: tuple[Patch, ...]
    """Patches that this step marks."""
    attempt: Attempt
    recorder: Recorder
    guard: ForceGuard


async def meanwhile(moving: Coroutine[Any, Any, None], work: Coroutine[Any, Any, _R]) -> _R:
    """Do `work` while the arm moves; return its result once both have ended, on failure and cancellation too.

    Raises the error of the motion before that of the work. Work that fails does not stop the arm, which is under way to
    where it may wait.
    """
    moved, done = await asyncio.gather(moving, work, return_exceptions=True)
    for ended in (moved, done):
        if isinstance(ended, BaseException):
            raise ended
    return cast("_R", done)


async def uninterrupted(function: Callable[..., _R], *args: object) -> _R:
    """Run `function` in a thread; on cancellation wait until it has returned.

    An unfinished file operation is worse than one that ends a few milliseconds after the stop key.
    """
    return await finished(asyncio.to_thread(function, *args))


async def within_limits(where: str, rig: RigConfig, poses: Iterable[PlannedPose]) -> None:
    """Check poses in a thread: it takes seconds for a long protocol, and a stop takes effect meanwhile.

    Raises `StepError`, which begins with `where`.
    """
    try:
        await asyncio.to_thread(check_poses, Path("rig.toml"), rig, poses)
    except ConfigError as error:
        raise StepError(f"{where}{error.what}") from None
