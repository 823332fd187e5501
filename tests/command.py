"""`brushloop` as one types it, within the test's own process: what it imports is imported once, not by every test."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from unittest import mock

from typer.testing import CliRunner

from brushloop.__main__ import app, main
from brushloop.calibrate.errors import StrokesLeftOut


def said(*words: object, left_out: bool = False) -> str:
    """What a command printed that ended well, with or without strokes that were left out, in one line."""
    ran = CliRunner().invoke(app, [*map(str, words)])
    assert isinstance(ran.exception, StrokesLeftOut) if left_out else ran.exit_code == 0, (ran.output, ran.exception)
    return " ".join(ran.output.split())


def refused(*words: object) -> str:
    """Why a command refuses its input: one line, with exit code 2."""
    ran = CliRunner().invoke(app, [*map(str, words)])
    assert getattr(ran.exception, "exit_code", None) == 2, (ran.output, ran.exception)
    assert "\n" not in str(ran.exception)
    return str(ran.exception)


def brushloop(*words: str | Path, cwd: Path | None = None, encoding: str = "utf-8") -> subprocess.CompletedProcess[str]:
    """What the command printed in this encoding, and its exit code, as if it had been a process in the folder `cwd`."""
    arguments = ["brushloop", *map(str, words)]
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding, write_through=True) for _ in range(2))
    code = 0
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(sys, "argv", arguments))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        if cwd is not None:
            stack.enter_context(contextlib.chdir(cwd))
        try:
            main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    printed = [stream.buffer.getvalue().decode(encoding) for stream in (out, err)]  # pyright: ignore[reportAttributeAccessIssue]
    return subprocess.CompletedProcess(arguments, code, *printed)
