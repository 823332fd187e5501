"""The rig as a process: it serves until a signal or until idle, writes its `rig.toml`, and listens on a control socket.

The control socket takes one JSON object per line and answers with one per line, over a unix socket of mode 0600:

| request | answer, in addition to `"ok": true` |
|---|---|
| `{"do": "add", "fault": {...}}` | `id` of the fault |
| `{"do": "list"}` | `hanging` and `over`: id, fault, number of strikes |
| `{"do": "clear"}`, or with `"id": 3` | `taken`: how many were removed |
| `{"do": "state"}` | state of the world: phase, tip, presses, ink load, modes |
| `{"do": "release"}` | `was`: the safety mode that a person at the arm has ended |
| `{"do": "fresh-sheet"}` | |

Anything else is answered with `{"ok": false, "error": "one line"}`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import stat
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import Any, ClassVar, cast

from drivers.sim.config import SimConfig
from drivers.sim.faults.board import Hung
from drivers.sim.faults.kinds import fault_of, hang_script, load_faults
from drivers.sim.rig import Faults, LoopbackRig
from drivers.sim.rig_toml import LOOPBACK_HEAD
from drivers.sim.server import LoopbackServer


def serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None] = lambda _text: None,
    *,
    faults: Path | None = None,
    control: Path | None = None,
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never); `faults` is an optional fault script.

    Raises `RigFileExists` rather than overwrite a file that no loopback rig wrote, `FaultScriptError`, and
    `ControlPathError` if the control socket cannot be created.
    """
    asyncio.run(_serve(config, write_rig, idle_exit_s, tell, faults, control))


async def _serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None],
    faults: Path | None,
    control: Path | None,
) -> None:
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    if write_rig is not None:
        _refuse_to_overwrite(write_rig)
    script = load_faults(faults) if faults is not None else ()
    async with LoopbackRig(config) as rig, live_control(rig.faults, control):
        if faults is not None:
            hang_script(faults, rig.faults.hang, script)
        loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
        if write_rig is not None:
            _write_whole(write_rig, rig.toml())
        tell(f"{rig.where()}; Ctrl-C ends")
        waits: list[asyncio.Task[object]] = [asyncio.create_task(over.wait())]
        if idle_exit_s > 0:
            waits.append(asyncio.create_task(rig.idle(idle_exit_s)))
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for wait in waits:
            wait.cancel()
        await asyncio.gather(*waits, return_exceptions=True)


class RigFileExists(Exception):
    """The file cannot be written: its folder is missing, or it is not from a loopback rig and may be a real rig's."""

    exit_code: ClassVar[int] = 2


def _refuse_to_overwrite(path: Path) -> None:
    if not path.parent.is_dir():
        raise RigFileExists(f"{path}: there is no folder {path.parent}")
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(LOOPBACK_HEAD.encode())):
        raise RigFileExists(f"{path}: exists and was not written by a loopback rig; it is not overwritten")


def _write_whole(path: Path, text: str) -> None:
    """Write the file so that a reader sees all of it or none."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


MAX_LINE_BYTES = 8192
MAX_CLIENTS = 16
MAX_PATH_BYTES = 100
"""Longest allowed path of a unix socket; the system's limit is slightly higher."""
FIELDS: dict[str, tuple[str, ...]] = {
    "add": ("fault",),
    "list": (),
    "clear": ("id",),
    "state": (),
    "release": (),
    "fresh-sheet": (),
}
"""Other keys allowed with each `do`."""
USAGE = (
    'not a request: {"do": "add", "fault": {...}}, or "list", "clear" (with a number "id" or without), '
    '"state", "release", "fresh-sheet"'
)


class ControlPathError(Exception):
    """The socket cannot be created at this path."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}")


class ControlServer(LoopbackServer):
    """Live control of the faults of one rig."""

    def __init__(self, faults: Faults) -> None:
        super().__init__()
        self._faults = faults
        self._path: Path | None = None
        self._made = (0, 0)

    async def open(self, path: Path) -> None:
        """Listen at `path`, replacing the socket of a rig that has ended. Raises `ControlPathError`."""
        listener = _listener(path)
        made = path.stat()
        self._path, self._made = path, (made.st_dev, made.st_ino)
        self._server = await asyncio.start_unix_server(self._serve, sock=listener, limit=MAX_LINE_BYTES)

    async def stop(self) -> None:
        """Close the listener and every client, and remove the socket."""
        await super().stop()
        path, self._path = self._path, None
        if path is not None:
            with contextlib.suppress(OSError):
                now = path.lstat()
                if (now.st_dev, now.st_ino) == self._made:
                    path.unlink()

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer line by line; an overlong line is answered, then the connection is closed."""
        if self.clients > MAX_CLIENTS:
            writer.write(_line(_error(f"more than {MAX_CLIENTS} clients")))
            return
        while True:
            try:
                line = await reader.readuntil(b"\n")
            except asyncio.LimitOverrunError:
                writer.write(_line(_error(f"a line has at most {MAX_LINE_BYTES} bytes")))
                return
            writer.write(_line(self.answer(line)))
            await writer.drain()

    def answer(self, line: bytes) -> dict[str, Any]:
        """The answer to a request; never raises, whatever a client sends."""
        try:
            request: Any = json.loads(line)
        except (ValueError, RecursionError):
            return _error("not JSON")
        try:
            return {"ok": True, **self._obey(request)}
        except ValueError as error:
            return _error(str(error))

    def _obey(self, said: object) -> dict[str, Any]:
        request = cast("dict[str, Any]", said) if isinstance(said, dict) else {}
        do = str(request.get("do"))
        if do not in FIELDS or not set(request) <= {"do", *FIELDS[do]}:
            raise ValueError(USAGE)
        board = self._faults.board
        match do, request.get("fault"), request.get("id"):
            case "add", dict(values), _:  # pyright: ignore[reportUnknownVariableType]
                return {"id": self._faults.hang(fault_of(values))}  # pyright: ignore[reportUnknownArgumentType]
            case "list", _, _:
                return {"hanging": [_as_json(h) for h in board.hanging], "over": [_as_json(h) for h in board.over]}
            case "clear", _, None:
                return {"taken": board.clear()}
            case "clear", _, int(ident) if not isinstance(ident, bool):
                return {"taken": int(board.take(ident))}
            case "state", _, _:
                return self._faults.state()
            case "release", _, _:
                return {"was": self._faults.release()}
            case "fresh-sheet", _, _:
                self._faults.fresh_sheet()
                return {}
            case _:
                raise ValueError(USAGE)


@contextlib.asynccontextmanager
async def live_control(faults: Faults, path: Path | None) -> AsyncGenerator[None]:
    """A control socket at `path` until the block ends; none if `path` is None. Raises `ControlPathError`."""
    server = ControlServer(faults)
    if path is not None:
        await server.open(path)
    try:
        yield
    finally:
        await server.stop()


def _as_json(hung: Hung) -> dict[str, Any]:
    fault = hung.fault.model_dump(mode="json", exclude_defaults=True)
    return {"id": hung.ident, "fault": fault, "struck": hung.struck}


def _error(text: str) -> dict[str, Any]:
    return {"ok": False, "error": text.replace("\n", " ")[:500]}


def _line(body: dict[str, Any]) -> bytes:
    return json.dumps(body, separators=(",", ":")).encode() + b"\n"


def _listener(path: Path) -> socket.socket:
    """A bound socket to which only its owner can connect. Raises `ControlPathError`."""
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise ControlPathError(path, f"the path of a socket has at most {MAX_PATH_BYTES} bytes")
    _clear_away(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    # Set before the path exists: another user could connect before a later `chmod`.
    mask = os.umask(0o177)
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise ControlPathError(path, f"cannot listen here: {error.strerror or error}") from None
    finally:
        os.umask(mask)
    listener.setblocking(False)
    return listener


def _clear_away(path: Path) -> None:
    """Remove a socket that has no listener; refuse to remove anything else."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise ControlPathError(path, "exists and is not a socket; it is not overwritten")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)
            return
    raise ControlPathError(path, "another rig listens here")
