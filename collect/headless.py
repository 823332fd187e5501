"""Collection without a screen: a progress bar with an ETA, and signals that end the run."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING

from brushloop.collect.engine.snapshot import Snapshot
from brushloop.sessions.terminal import plain_console

if TYPE_CHECKING:
    from brushloop.collect.engine.engine import Engine

REFRESH_S = 0.1
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def run_headless(engine: Engine) -> None:
    """Run to the end; raise the error that ended the run. If the output goes away, the step ends and the arm parks."""
    with stop_signals(partial(obey, engine)):
        engine.start()
        try:
            # The terminal or pipe may be gone; rich turns a broken pipe into a SystemExit.
            with contextlib.suppress(OSError, SystemExit):
                _show(engine)
        finally:
            if not engine.finished:
                engine.park()
            engine.join()


def obey(engine: Engine, number: int) -> None:
    """On SIGHUP finish the step, lift and park: nobody is there to lift a brush that was stopped on the paper. On any
    other signal stop at once, also while the arm is being parked."""
    (engine.park if number == signal.SIGHUP else engine.stop)()


def _show(engine: Engine) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    shown, silent = 0, False
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[eta]}"),
    )
    with Progress(*columns, console=plain_console(stderr=True)) as progress:
        task = progress.add_task("connect", total=None, eta="")
        while True:
            over = engine.finished
            now = engine.snapshot()
            for line in now.messages[max(shown - now.messages_before, 0) :]:
                progress.console.print(line, highlight=False)
            shown = now.messages_before + len(now.messages)
            if (now.no_pose_s is not None) is not silent:
                silent = now.no_pose_s is not None
                line = f"warning: {no_pose_text(now)}" if silent else "the arm sends its pose again"
                progress.console.print(line, highlight=False)
            progress.update(
                task,
                description=", ".join(part for part in (f"{now.state}: {now.step}", no_pose_text(now)) if part),
                completed=now.strokes_done,
                total=now.strokes_planned,
                eta=eta_text(now),
            )
            if over:
                return
            time.sleep(REFRESH_S)


def eta_text(now: Snapshot) -> str:
    """`ETA 12:05`, or nothing while no stroke has been timed."""
    if now.eta_s is None:
        return ""
    return f"ETA {minutes_text(now.eta_s)}"


def minutes_text(seconds: float) -> str:
    """Minutes and seconds as `12:05`."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def no_pose_text(now: Snapshot) -> str:
    """`no pose for 1.4 s`, or nothing while the arm sends its pose."""
    if now.no_pose_s is None:
        return ""
    return f"no pose for {now.no_pose_s:.{1 if now.no_pose_s < 10.0 else 0}f} s"


@contextmanager
def stop_signals(handle: Callable[[int], object], numbers: Sequence[signal.Signals] = STOP_SIGNALS) -> Generator[None]:
    """Call `handle` with the number of each of these signals, in a separate thread."""

    def on_signal(number: int, _frame: FrameType | None) -> None:
        # Not from the handler itself: it may have interrupted code that holds the engine's lock.
        threading.Thread(target=handle, args=(number,), name="stop key").start()

    before = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
