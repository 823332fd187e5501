"""The engine: runs a protocol on a rig in its own thread and event loop, and presses each stroke exactly once. Screens
read `Snapshot`s.

To resume, the protocol runs from its first step, and every step that is done in the journal returns its stored result
without any motion (see `run.py`).
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import math
import signal
import threading
from collections.abc import Callable, Generator
from pathlib import Path

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.live import no_wider
from brushloop.collect.engine.open_or_resume import Opening, find_resumable, open_store
from brushloop.collect.engine.recorder import uninterrupted
from brushloop.collect.engine.run import Run
from brushloop.collect.engine.snapshot import Picture, Progress, Snapshot
from brushloop.collect.errors import NOT_AT_REST, CollectAborted, ConfigError, describe, rest_is_unknown
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.photograph.frames import each_frame
from brushloop.collect.photograph.measure import blur_px, busiest_tile
from brushloop.collect.rig.devices import Rig, connected
from brushloop.collect.walk import check_protocol, sheet_of
from brushloop.drivers.devices import Frame
from brushloop.drivers.errors import DeviceError, NotConnected, Stale
from brushloop.drivers.host import Clock
from brushloop.sessions.disk import check_writable
from brushloop.sessions.errors import SessionError
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.store import SessionStore

PARKED_MM = 2.0
"""Distance from the park position, in mm, within which the arm counts as parked."""
PICTURE_PX = 320
"""Largest width of the camera's picture on a screen."""
SILENT_MS = 1000.0
"""Time without a pose after which the snapshot says so: the arm or the connection to it has failed."""
UNCHECKED = (
    "no self-check: rig.toml switches it off, or neither rig.toml nor --arm asks for it. Nothing checks whether arm, "
    "camera and configuration agree"
)

ARM = Choice("a", "let the arm move: I look at the robot cell, my hand is at the emergency stop")
LEAVE = Choice("x", "do not let the arm move")
CUT_OFF = "The last run was cut off: look where it left the arm."
RESUMED = (
    "The arm first lifts the brush slowly and parks; the board and the paper are found again, and the plan goes on. "
    "No stroke is made twice."
)
RESUME = Choice("g", "resume: the arm is at rest, everybody is out of its reach, my hand is at the emergency stop")
NOT_NOW = Choice("x", "do not resume")


class Engine:
    """Runs one session. Call `start`, look at `snapshot` until `finished`, then call `join`."""

    new_event_loop: Callable[[], asyncio.AbstractEventLoop] = staticmethod(asyncio.new_event_loop)
    """Makes the event loop of the run."""

    def __init__(self, opening: Opening, resumes: Path | None, clock: Clock) -> None:
        """`resumes`: folder of the session that is resumed; None for a new one."""
        self._request = opening.request
        self._rig_config = opening.rig
        self._resumes = resumes
        progress = Progress(opening.protocol, clock, sheet_of(opening.rig, opening.protocol), resumes)
        self._run = Run(opening, progress, Asker(watched=bool(self._request.on_screen), waiting=self._waiting))
        self.control = self._run.control
        """State of the run, and what is asked of it: to pause and resume, and the operator's requests."""
        self._clock = clock
        self._task: asyncio.Task[None] | None = None
        self._stopper: asyncio.Task[None] | None = None
        self._rig: Rig | None = None
        self._store: SessionStore | None = None
        self._stop_failure: DeviceError | None = None
        self._rest_unknown = False
        self._thread = threading.Thread(target=self._run_thread, name="engine", daemon=True)
        self._outcome: concurrent.futures.Future[None] = concurrent.futures.Future()

    def start(self) -> None:
        """Begin in the engine's own thread."""
        self._thread.start()

    @property
    def finished(self) -> bool:
        """True once the run is over, however it ended."""
        return self._outcome.done()

    def join(self) -> None:
        """Wait for the end of the run. Raises what ended it: `CollectAborted`, or a device, step or session error."""
        self._thread.join()
        self._outcome.result()

    def snapshot(self) -> Snapshot:
        """The state of the run; from any thread."""
        tip_mm = force_n = no_pose_s = None
        state = self.control.state
        if (rig := self._rig) is not None:
            try:
                tip_mm = self._run.progress.tip_mm = rig.robot.latest().pose.position_mm
            except Stale as stale:
                if stale.age_ms >= SILENT_MS and state not in FINAL:
                    no_pose_s = stale.age_ms / 1e3
            except DeviceError:
                pass
            if rig.force is not None:
                with contextlib.suppress(DeviceError):
                    self._run.progress.force(sample := rig.force.latest())
                    force_n = math.hypot(*sample.force_n)
        seen_mm, park_mm = self._run.progress.tip_mm, self._rig_config.motion.park_mm
        return self._run.progress.snapshot(
            state=state,
            tip_mm=tip_mm,
            force_n=force_n,
            prompt=self._run.asker.prompt,
            target_mm=None if rig is None else self._run.procedures.target_mm,
            parked=not self._rest_unknown and seen_mm is not None and math.dist(seen_mm, park_mm) < PARKED_MM,
            rest_unknown=self._rest_unknown,
            requests=self.control.requests,
            no_pose_s=no_pose_s,
        )

    def _show_frame(self, frame: Frame) -> None:
        blur = blur_px(busiest_tile(frame.image))
        self._run.progress.picture = Picture(no_wider(frame.image, PICTURE_PX), blur)

    def park(self) -> None:
        """End the run after this step with the arm lifted and parked; no more questions are asked. From any thread."""
        self.control.park()
        self._run.asker.abandon()

    def answer(self, number: int, key: str) -> bool:
        """Answer question `number`; False if it is closed. From any thread."""
        return self._run.asker.answer(number, key)

    def obey(self, signal_number: int) -> None:
        """On SIGHUP finish the step, lift and park: nobody is there to lift a brush that was stopped on the paper. On
        any other signal stop at once, also while the arm is being parked."""
        (self.park if signal_number == signal.SIGHUP else self.stop)()

    def stop(self) -> None:
        """Stop the arm now and end the run; from any thread, in any state, any number of times."""
        self.control.stop(self._stop_now)

    def _stop_now(self) -> None:
        if self._stopper is None or self._stopper.done():
            self._stopper = asyncio.create_task(self._stop_arm(), name="stop")
        # Once everything is collected the arm is parked, and the merge must not be cut short.
        if self._task is not None and not self.control.closing and not self._task.cancelling():
            self._task.cancel()

    async def _stop_arm(self) -> None:
        # Stop uses its own socket: it waits neither for the session's task nor for anything that blocks that task.
        if self._rig is not None:
            try:
                await self._rig.robot.stop()
            except DeviceError as error:
                self._stop_failure = error
                self._run.progress.log(describe(error), warning=True)

    def _run_thread(self) -> None:
        try:
            with asyncio.Runner(loop_factory=self.new_event_loop) as runner:
                runner.run(self._main())
        except BaseException as error:
            self._outcome.set_exception(error)
        else:
            self._outcome.set_result(None)

    async def _main(self) -> None:
        self._task = asyncio.create_task(self._session(), name="session")
        self.control.entered(self._task)
        try:
            await self._until_stopped(self._task)
        except CollectAborted as error:
            self._end(State.STOPPED, error)
            raise
        except Exception as error:
            # After a stop that failed, the arm was not seen at rest either.
            self._rest_unknown = error is self._stop_failure or rest_is_unknown(error)
            self._end(State.FAILED, error)
            raise
        finally:
            if self._stopper is not None:
                await self._stopper
            if self._store is not None:
                self._store.release()

    async def _until_stopped(self, session: asyncio.Task[None]) -> None:
        """Raise what ends the session; of a stop, `CollectAborted`, or why the arm was not seen at rest."""
        try:
            await session
        except asyncio.CancelledError:
            if self._stopper is not None:
                await self._stopper
            if self._stop_failure is not None and not isinstance(self._stop_failure, NotConnected):
                raise self._stop_failure from None
            raise CollectAborted("stopped; the session can be resumed with the same command") from None

    async def _session(self) -> None:
        run = self._run
        run.progress.doing("connect")
        async with connected(self._rig_config, self._clock, run.progress.log) as rig:
            run.connected(rig)
            self._rig = rig
            await self._permitted(rig)
            store = self._store = run.store = open_store(run.opening, self._resumes, rig, self._clock)
            dry, live = self._request.dry_run_mm is not None, run.opening.live
            try:
                strokes = run.progress.opened(store)
                begun = f"resumed with {strokes} strokes" if strokes else "session"
                run.progress.log("dry run: nothing is pressed, dipped or kept" if dry else f"{begun}: {store.folder}")
                if (self._request.armed or not rig.simulated) and not dry and not self._rig_config.self_check.enabled:
                    run.progress.log(UNCHECKED, warning=True)
                if live is not None:
                    run.progress.log(f"live view: {live.url}")
                shows = ([self._show_frame] if self._request.on_screen else []) + ([live.frame] if live else [])
                async with each_frame(rig.camera, shows):
                    await run.carry_out()
                run.control.begin_closing()
                run.progress.doing("merge and verify")
                final = await uninterrupted(store.close)
                run.progress.log("dry run: every move was made" if dry else f"closed: {final}")
                run.progress.over()
            finally:
                self.snapshot()  # the last look at the tip
        run.control.end(State.DONE)

    async def _permitted(self, rig: Rig) -> None:
        """Ask whether a session may be resumed, however it was asked for, and whether real hardware may move, unless
        the command line allows it. Nothing has been opened, powered or moved yet.

        Raises `ConfigError` if nobody can answer, `CollectAborted` if the answer is no.
        """
        robot, arm = rig.config.robot, rig.identities["robot"]
        real, hardware = not arm.simulated, f"{arm.model} at {robot.host}:{robot.port} is real hardware"
        if self._resumes is not None and self._request.on_screen:
            state = replay(self._resumes / JOURNAL_NAME)
            self._run.progress.count(state)
            before = f"The last run ended with: {state.ended}" if state.ended else CUT_OFF
            text = f"Resume {self._resumes.name}? {before}\n{f'{hardware}. ' if real else ''}{RESUMED}"
            prompt = Prompt(text, (RESUME, NOT_NOW), NOT_NOW.key)
        elif self._request.armed or not real:
            return
        elif self._request.on_screen:
            prompt = Prompt(f"{hardware}. May the arm move?", (ARM, LEAVE), LEAVE.key)
        else:
            raise ConfigError(
                "rig.toml", "robot", f"{hardware}: look at the robot cell, keep a hand at the emergency stop, add --arm"
            )
        if await self._run.asker.ask_or_default(prompt) == prompt.default:
            raise CollectAborted("nobody confirmed that the arm may move; nothing was powered and nothing moved")

    @contextlib.contextmanager
    def _waiting(self) -> Generator[None]:
        """While a question waits, the run is asking."""
        self.control.move_to(State.ASKING)
        try:
            with self._run.progress.meanwhile("wait for an answer"):
                yield
        finally:
            self.control.move_to(State.RUNNING)

    def _end(self, state: State, error: Exception) -> None:
        """End with `error`, whose message says so if the arm may move or the brush may be down. The session keeps it
        for the person who resumes."""
        tip_mm, config = self._run.progress.tip_mm, self._rig_config
        if self._rest_unknown:
            error.add_note(NOT_AT_REST)
        if tip_mm is not None and (self._rest_unknown or tip_mm[2] < config.motion.safe_z_mm - PARKED_MM):
            above_mm = tip_mm[2] - config.paper.touch_z_mm
            where = f"{abs(above_mm):.1f} mm {'above' if above_mm > 0.0 else 'below'} the height of the paper"
            error.add_note(
                f"The brush may be down: its tip was last seen {where}. Clear the way above it: a resumed "
                "run first lifts the brush along its axis. Or lift it with the pendant."
            )
        self.control.end(state)
        self._run.progress.over(describe(error))
        if self._store is not None:
            with contextlib.suppress(SessionError):
                self._store.ended(describe(error))


def engine_for(opening: Opening) -> Engine:
    """Make an engine that resumes the open session or begins a new one; connects nothing yet. Raises `ConfigError`."""
    request, resume = opening.request, find_resumable(opening)
    check_protocol(request.config, request.protocol, opening.rig, opening.protocol)
    check_writable(resume or request.out)
    return Engine(opening, resume, Clock())
