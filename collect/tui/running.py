"""Runs the app around engines, so that no arm is ever left unwatched: signals, lost terminals, its own defects."""

from __future__ import annotations

import contextlib
import signal
from contextlib import AbstractContextManager

from collect.errors import CollectAborted
from collect.headless import RunnableEngine, stop_signals
from collect.tui.app import OperatorApp
from collect.tui.browser import Desk, Paths
from collect.tui.pictures import Kind, Pictures


class ScreenCrashed(Exception):
    """The screen ended by a defect of its own, which it has printed; the arm was stopped."""


def run_screen(engine: RunnableEngine, preview: Kind = "cells") -> None:
    """Run under the screen until the operator leaves; raises what ended the run."""
    app = OperatorApp(engine, pictures=Pictures(preview))
    with _signals(app):
        engine.start()
        _run(app)
        engine.join()


def run_desk(paths: Paths, preview: Kind = "cells") -> None:
    """The start screen, and from it as many runs as a day has; raises what ended the last one."""
    app = OperatorApp(desk=Desk(paths), pictures=Pictures(preview))
    with _signals(app):
        _run(app)
        if app.engine is not None:
            app.engine.join()


def _run(app: OperatorApp) -> None:
    intact = False
    try:
        app.run()
        # A screen that lost its terminal was told to leave; that is no defect.
        intact = app.leaving or not app.return_code
    finally:
        engine = app.engine
        if engine is not None:
            # However the screen ended, nobody watches the arm any more. One that parks already goes on with that.
            if not engine.finished and not app.leaving:
                engine.stop()
            if not intact:
                # The engine's thread dies with the process: let it bring the arm to rest and close the session first.
                with contextlib.suppress(CollectAborted):
                    engine.join()
    if not intact:
        raise ScreenCrashed("the screen crashed; the arm was stopped")


def _signals(app: OperatorApp) -> AbstractContextManager[None]:
    """SIGINT and SIGTERM stop the arm at once. SIGHUP, a terminal that is lost, finishes the step and parks the arm:
    nobody is there to lift a brush that was stopped on the paper. Each ends the screen."""

    def heed(number: int) -> None:
        if app.engine is not None:
            (app.engine.park if number == signal.SIGHUP else app.engine.stop)()
        app.leave()

    return stop_signals(heed)
