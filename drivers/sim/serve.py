"""The rig as a process: it serves until a signal or until idle, writes its `rig.toml`, and may be controlled live.

The control socket takes one JSON object per line and answers with one per line, over a unix socket of mode 0600:

| request | answer, in addition to `"ok": true` |
|---|---|
| `{"do": "add", "fault": {...}}` | `id` of the fault |
| `{"do": "list"}` | `hanging` and `over`: id, fault, number of strikes |
| `{"do": "clear"}`, or with `"id": 3` | `taken`: how many were removed |
| `{"do": "state"}` | state of the world: phase, tip, presses, ink load, modes |
| `{"do": "release"}` | `was`: the safety mode that a person at the arm has ended |
| `{"do": "fresh-sheet"}` | |
| `{"do": "hand", "act": ...}` | `says`, and `reached` for an act that moves the arm; only in an unknown lab |

Anything else is answered with `{"ok": false, "error": "one line"}`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any, ClassVar, cast

from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.brush.spec import SimFileError
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Hung, fault_of
from brushloop.drivers.sim.rig import LOOPBACK_HEAD, LoopbackRig

Person = Callable[[Mapping[str, object]], Awaitable[dict[str, Any]]]
"""Carries out a `hand` request. Raises ValueError, with a one-line message, for an invalid request."""
USAGE = (
    'not a request: {"do": "add", "fault": {...}}, or "list", "clear" (with a number "id" or without), '
    '"state", "release", "fresh-sheet", "hand"'
)


class ControlServer(LoopbackServer):
    """Live control of the faults of one rig, and of the person in its lab if there is one."""

    def __init__(self, rig: LoopbackRig, person: Person | None = None) -> None:
        super().__init__()
        self._rig = rig
        self._person = person

    async def open(self, path: Path) -> None:
        """Listen at `path` for its owner alone; a socket of a rig that has ended is replaced. Raises `SimFileError`."""
        if path.exists() and not path.is_socket():
            raise SimFileError(path, "", "exists and is not a socket; it is not overwritten")
        if _listens(path):
            raise SimFileError(path, "", "another rig listens here")
        # Set before the path exists: another user could connect before a later `chmod`.
        mask = os.umask(0o177)
        try:
            self._server = await asyncio.start_unix_server(self._serve, path)
        except OSError as error:
            raise SimFileError(path, "", f"cannot listen here: {error.strerror or error}") from None
        finally:
            os.umask(mask)

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer line by line."""
        while True:
            line = await reader.readuntil(b"\n")
            try:
                answer = {"ok": True, **await self._obey(json.loads(line))}
            except (ValueError, RecursionError) as error:
                text = "not JSON" if isinstance(error, json.JSONDecodeError | RecursionError) else str(error)
                answer = {"ok": False, "error": text.replace("\n", " ")[:500]}
            writer.write(json.dumps(answer, separators=(",", ":")).encode() + b"\n")
            await writer.drain()

    async def _obey(self, said: object) -> dict[str, Any]:
        request = cast("dict[str, Any]", said) if isinstance(said, dict) else {}
        board, alone = self._rig.faults, len(request) == 1
        match request:
            case {"do": "add", "fault": dict()} if len(request) == 2:
                return {"id": board.hang(fault_of(request["fault"]))}
            case {"do": "list"} if alone:
                return {"hanging": [_as_json(h) for h in board.hanging], "over": [_as_json(h) for h in board.over]}
            case {"do": "clear"} if alone:
                return {"taken": board.clear()}
            case {"do": "clear", "id": int(ident)} if len(request) == 2 and not isinstance(ident, bool):
                return {"taken": int(board.take(ident))}
            case {"do": "state"} if alone:
                return self._rig.state()
            case {"do": "release"} if alone:
                return {"was": self._rig.arcs.cabinet.release()}
            case {"do": "fresh-sheet"} if alone:
                self._rig.world.fresh_sheet()
                return {}
            case {"do": "hand"} if set(request) <= {"do", "act", "to", "index", "corner"}:
                if self._person is None:
                    raise ValueError("there is no person here: only the lab of `brushloop sim --unknown` has one")
                return await self._person(request)
            case _:
                raise ValueError(USAGE)


@contextlib.asynccontextmanager
async def live_control(rig: LoopbackRig, path: Path | None, person: Person | None = None) -> AsyncGenerator[None]:
    """A control socket at `path` until the block ends; none if `path` is None. Raises `SimFileError`."""
    if path is None:
        yield
        return
    server = ControlServer(rig, person)
    await server.open(path)
    try:
        yield
    finally:
        await server.stop()
        path.unlink(missing_ok=True)


def _as_json(hung: Hung) -> dict[str, Any]:
    fault = hung.fault.model_dump(mode="json", exclude_defaults=True)
    return {"id": hung.ident, "fault": fault, "struck": hung.struck}


def _listens(path: Path) -> bool:
    """Whether a rig answers at this socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True


def serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None] = lambda _text: None,
    *,
    control: Path | None = None,
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never).

    Raises `SimFileError` for a control socket that cannot be created, and rather than overwrite a file that no loopback
    rig wrote.
    """
    if write_rig is not None:
        _refuse_to_overwrite(write_rig)
    rig = LoopbackRig(config)

    def announce() -> None:
        if write_rig is not None:
            _write_whole(write_rig, rig.toml())
            tell(f"{write_rig} is written: brushloop doctor --config {write_rig}")
        tell(f"{rig.where()}; Ctrl-C ends")

    asyncio.run(_until_over(rig, rig, live_control(rig, control), idle_exit_s, announce))


class LabRefused(Exception):
    """No such lab can be served."""

    exit_code: ClassVar[int] = 2


def serve_unknown(
    seed: int, trap: str | None, rate: float, idle_exit_s: float, tell: Callable[..., None], control: Path | None
) -> None:
    """Serve the unknown lab of this seed and print what a person reads there.

    Raises `LabRefused` for an unknown trap, and `SimFileError` for the control socket.
    """
    from brushloop.drivers.sim.lab import UnknownLab
    from brushloop.drivers.sim.lab_facts import Trap

    if trap is not None and trap not in [*Trap]:
        raise LabRefused(f"--trap is {trap!r}, allowed: {', '.join(Trap)}")
    lab = UnknownLab(seed, None if trap is None else Trap(trap), rate=rate)

    def announce() -> None:
        hand = [] if control is None else [f"hand      brushloop sim hand {control} bring pin"]
        tell(*lab.labels(), *hand, "Ctrl-C ends")

    asyncio.run(_until_over(lab, lab.rig, live_control(lab.rig, control, lab.obey), idle_exit_s, announce))


async def _until_over(
    serving: AbstractAsyncContextManager[object],
    rig: LoopbackRig,
    controlled: AbstractAsyncContextManager[None],
    idle_exit_s: float,
    announce: Callable[[], None],
) -> None:
    """Serve until Ctrl-C, SIGTERM, or no client for `idle_exit_s`; SIGUSR1 changes the sheet."""
    over, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    async with serving, controlled:
        announce()
        loop.add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
        if idle_exit_s > 0:
            idle = asyncio.create_task(rig.idle(idle_exit_s))
            idle.add_done_callback(lambda _: over.set())
        await over.wait()


def _refuse_to_overwrite(path: Path) -> None:
    if not path.parent.is_dir():
        raise SimFileError(path, "", f"there is no folder {path.parent}")
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(LOOPBACK_HEAD.encode())):
        raise SimFileError(path, "", "exists and was not written by a loopback rig; it is not overwritten")


def _write_whole(path: Path, text: str) -> None:
    """Write the file so that a reader sees all of it or none."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise SimFileError(path, "", f"cannot be written: {error.strerror}") from None
