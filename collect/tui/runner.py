"""Runs the app so that no arm is left unwatched after a signal, a lost terminal or a crash of the screen."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager

from brushloop.collect.errors import CollectAborted
from brushloop.collect.headless import RunnableEngine, obey, stop_signals
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.browser import SessionBrowser
from brushloop.collect.tui.pictures import Pictures, Preview
from brushloop.collect.tui.terminal import theme_file


class ScreenCrashed(Exception):
    """The screen crashed and has printed the error; the arm was stopped."""


def run_screen(
    engine: RunnableEngine, preview: Preview = "auto", again: Callable[[str], RunnableEngine] | None = None
) -> RunnableEngine:
    """Run under the screen until the operator leaves; raises what ended the run.

    `again` makes the engine that resumes a session after a stop. Returns the engine that ran last.
    """
    app = OperatorApp(engine, again=again, pictures=Pictures(preview), theme_file=theme_file())
    with _signals(app):
        engine.start()
        _run(app)
        assert app.engine is not None
        app.engine.join()
        return app.engine


def run_browser(browser: SessionBrowser) -> None:
    """Show the start screen, and run what is started from it; raises what ended the last run."""
    app = OperatorApp(browser=browser, pictures=Pictures("auto"), theme_file=theme_file())
    with _signals(app):
        _run(app)
        if app.engine is not None:
            app.engine.join()


def _run(app: OperatorApp) -> None:
    intact = False
    try:
        app.run()
        # A screen that ended because its terminal was lost did not crash.
        intact = app.leaving or not app.return_code
    finally:
        engine = app.engine
        if engine is not None:
            # However the screen ended, nobody watches the arm from here on. An arm that is already parking continues.
            if not engine.finished and not app.leaving:
                engine.stop()
            if not intact:
                # The engine's thread dies with the process: let it bring the arm to rest and close the session first.
                with contextlib.suppress(CollectAborted):
                    engine.join()
    if not intact:
        raise ScreenCrashed("the screen crashed; the arm was stopped")


def _signals(app: OperatorApp) -> AbstractContextManager[None]:
    """On a signal end the run as without a screen, then the screen."""

    def on_signal(number: int) -> None:
        if app.engine is not None:
            obey(app.engine, number)
        app.leave()

    return stop_signals(on_signal)
