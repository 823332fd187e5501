"""The engine: interprets a protocol on a rig, one step at a time, so that a stroke is pressed exactly once.

Resume is memoised replay: the generator runs from the top, and a step that the journal says is done gets its stored
result while nothing moves. The engine runs in its own thread with its own event loop; screens see `Snapshot`s.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
from collections.abc import Callable

from collect.config import GridConfig, RigConfig
from collect.errors import CollectAborted, StepError, told
from collect.perform import Performer, uninterrupted
from collect.policy import Action, decide
from collect.progress import Progress
from collect.protocol import grid
from collect.rig import Rig, connected
from collect.snapshot import Snapshot
from collect.states import FINAL, State, check_transition
from collect.steps import Result, Step
from drivers.clock import Clock
from drivers.errors import DeviceError, MotionError, NotConnected, RpcError
from sessions.store import SessionStore

OpenStore = Callable[[Rig], SessionStore]
"""Makes or resumes the session, once the devices have said who they are and before anything is powered."""


class Engine:
    """Runs one session. `start`, then look at `snapshot` until `finished`, then `join`."""

    def __init__(self, rig: RigConfig, protocol: GridConfig, open_store: OpenStore, clock: Clock) -> None:
        self._rig_config = rig
        self._protocol_config = protocol
        self._open_store = open_store
        self._progress = Progress(protocol, clock)
        self._clock = clock
        self._state = State.IDLE
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._stopper: asyncio.Task[None] | None = None
        self._go_on = asyncio.Event()
        self._rig: Rig | None = None
        self._stop_wanted = False
        self._pause_wanted = False
        self._stop_failure: DeviceError | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run_thread, name="engine", daemon=True)
        self._outcome: concurrent.futures.Future[None] = concurrent.futures.Future()

    def start(self) -> None:
        """Begin in the engine's own thread."""
        self._thread.start()

    @property
    def finished(self) -> bool:
        """True once the run is over, in whatever way."""
        return self._outcome.done()

    def join(self) -> None:
        """Wait for the end; raises what ended the run: `CollectAborted`, or a device, step or session error."""
        try:
            self._outcome.result()
        finally:
            self._thread.join()

    def snapshot(self) -> Snapshot:
        """The engine now; from any thread."""
        tip_mm = None
        if self._rig is not None:
            with contextlib.suppress(DeviceError):
                tip_mm = self._rig.robot.latest().pose.position_mm
        return self._progress.snapshot(self._state, tip_mm)

    def pause(self) -> None:
        """Pause before the next step."""
        with self._lock:
            self._pause_wanted = True
            if self._state == State.RUNNING:
                self._set(State.PAUSING)

    def resume(self) -> None:
        """Go on after a pause, or forget one that has not begun."""
        with self._lock:
            self._pause_wanted = False
            if self._state == State.PAUSING:
                self._set(State.RUNNING)
            if self._loop is not None and self._state not in FINAL:
                self._loop.call_soon_threadsafe(self._go_on.set)

    def stop(self) -> None:
        """Stop the arm now and end the run; from any thread, in any state, any number of times."""
        with self._lock:
            self._stop_wanted = True
            if self._loop is None or self._state in FINAL:
                return
            if self._state != State.STOPPING and not self._closing:
                self._set(State.STOPPING)
            self._loop.call_soon_threadsafe(self._stop_now)

    def _stop_now(self) -> None:
        if self._stopper is None or self._stopper.done():
            self._stopper = asyncio.create_task(self._stop_arm(), name="stop")
        # Once all is collected the arm is parked; the merge ends by itself and loses nothing.
        if self._task is not None and not self._closing and not self._task.cancelling():
            self._task.cancel()

    async def _stop_arm(self) -> None:
        # Its own socket: it neither waits for the session's task nor for what that waits for.
        if self._rig is not None:
            try:
                await self._rig.robot.stop()
            except DeviceError as error:
                self._stop_failure = error
                self._progress.log(told(error), warning=True)

    def _run_thread(self) -> None:
        try:
            asyncio.run(self._main())
        except BaseException as error:
            self._outcome.set_exception(error)
        else:
            self._outcome.set_result(None)

    async def _main(self) -> None:
        with self._lock:
            self._loop = asyncio.get_running_loop()
            self._task = asyncio.create_task(self._session(), name="session")
            if self._stop_wanted:
                self._task.cancel()
        try:
            await self._task
        except asyncio.CancelledError:
            await self._stopped()
        except Exception as error:
            self._end(State.FAILED, told(error))
            raise
        finally:
            if self._stopper is not None:
                await self._stopper
            with self._lock:
                self._loop = None

    async def _stopped(self) -> None:
        if self._stopper is not None:
            await self._stopper
        if self._stop_failure is not None and not isinstance(self._stop_failure, NotConnected):
            # Never told as stopped: the arm was not seen at rest.
            self._end(State.FAILED, told(self._stop_failure))
            raise self._stop_failure
        self._end(State.STOPPED, "stopped by the operator")
        raise CollectAborted("stopped; the same command goes on from here")

    async def _session(self) -> None:
        self._progress.doing("connect")
        async with connected(self._rig_config, self._clock, self._progress.log) as rig:
            self._rig = rig
            store = self._open_store(rig)
            try:
                self._progress.opened(store)
                await self._protocol(rig, store)
                with self._lock:
                    if self._state == State.STOPPING:
                        raise asyncio.CancelledError
                    self._closing = True
                self._progress.doing("merge and verify")
                final = await uninterrupted(store.close)
                self._progress.closed(f"closed: {final}")
            finally:
                store.release()
        with self._lock:
            self._set(State.DONE)

    async def _protocol(self, rig: Rig, store: SessionStore) -> None:
        performer = Performer(rig, store, self._progress)
        self._progress.doing("power on")
        await rig.robot.enable()
        await self._recover(performer)
        protocol = grid(self._protocol_config)
        step = next(protocol)
        with contextlib.suppress(StopIteration):
            while True:
                step = protocol.send(await self._result(performer, store, step))

    async def _result(self, performer: Performer, store: SessionStore, step: Step) -> Result:
        known = store.state.done.get(step.key)
        if known is not None and not step.run_scoped:
            return known["result"]
        failures = 0
        while True:
            await self._pause_point()
            try:
                return await performer.perform(step)
            except (StepError, DeviceError) as error:
                failures += 1
                action = decide(step, error, failures)
                self._progress.log(f"{step.kind}: {error} -> {action}", warning=True)
                if action is Action.ABORT:
                    await self._lift(performer, error)
                    raise
                await self._recover(performer)

    async def _lift(self, performer: Performer, error: StepError | DeviceError) -> None:
        """Leave no brush in the paper, where the arm itself is in order: not after its own trouble."""
        if isinstance(error, MotionError | RpcError) or getattr(error, "device", "") == "robot":
            return
        try:
            await self._recover(performer)
        except (StepError, DeviceError) as failure:
            error.add_note(f"The brush could not be lifted: {failure}")

    async def _recover(self, performer: Performer) -> None:
        self._move_to(State.RECOVERING)
        self._progress.doing("retreat")
        await performer.retreat()
        self._move_to(State.PAUSING if self._pause_wanted else State.RUNNING)

    async def _pause_point(self) -> None:
        with self._lock:
            if self._state != State.PAUSING:
                return
            self._set(State.PAUSED)
        self._progress.doing("paused")
        while self._pause_wanted:
            self._go_on.clear()
            await self._go_on.wait()
        self._move_to(State.RUNNING)

    def _move_to(self, new: State) -> None:
        with self._lock:
            if self._state == State.STOPPING:
                raise asyncio.CancelledError  # the stop key was faster than this step
            self._set(new)

    def _set(self, new: State) -> None:
        check_transition(self._state, new)
        self._state = new

    def _end(self, state: State, why: str) -> None:
        with self._lock:
            if state is State.STOPPED and self._state is not State.STOPPING:
                self._set(State.STOPPING)
            self._set(state)
        self._progress.ended(why)
