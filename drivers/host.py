"""The host computer: its clock, work that outlives its caller or ends with it, and one driver per device.

On Linux a claim on a device is an abstract socket, a name kept by the kernel: it leaves no file behind, ends with its
process in any case, and is visible to every user of the machine, but not in a container with a separate network. On
other systems it is a lock on a file that every user may open, in a folder shared by all users.
"""

import asyncio
import contextlib
import errno
import os
import socket
import struct
import sys
import time
from collections.abc import AsyncGenerator, Coroutine
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout


class Clock:
    """Wall time read once, then carried forward by the monotonic clock: it never goes backwards.

    An NTP step or an operator who sets the clock during a session must not reorder a recording.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Nanoseconds since the epoch: wall time when this clock was created, plus monotonic time since."""
        return self._offset_ns + time.monotonic_ns()


T = TypeVar("T")


async def finished(work: Coroutine[Any, Any, T]) -> T:
    """Run `work` to its end, however often the caller is cancelled meanwhile, and return its result.

    If `work` fails, its error is raised, because it tells more than a cancellation; else a cancellation is raised now.
    """
    task, cancelled = asyncio.ensure_future(work), None
    while not task.done():
        try:
            await asyncio.wait([task])
        except asyncio.CancelledError as error:
            cancelled = error
    result = task.result()
    if cancelled is not None:
        raise cancelled
    return result


@contextlib.asynccontextmanager
async def alongside(work: Coroutine[Any, Any, None], name: str) -> AsyncGenerator[None]:
    """Run `work` as a task of this name within the block; then cancel it and wait for its end. Its error is dropped."""
    task = asyncio.create_task(work, name=name)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


WAITING = 64
"""Length of the backlog: refused processes connect to learn who holds the name, and are never served."""

UNNAMED = "a process that cannot be named"


class Claimed(Exception):
    """Another process holds the name; the message says which one, if that is known."""


def claimed(name: str) -> contextlib.AbstractContextManager[object]:
    """Claim `name` on this machine, and hold it until the block, or the process, ends. Raises `Claimed`."""
    return _named_socket(name) if sys.platform == "linux" else _file(name)


def _named_socket(name: str) -> socket.socket:
    address = f"\0{name}"
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        claim.bind(address)
    except OSError as error:
        claim.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise Claimed(_holder(address)) from None
    claim.listen(WAITING)
    return claim


def _holder(address: str) -> str:
    """The process that listens at `address`, and its user, as the kernel reports them."""
    import pwd  # not on every system

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(address)
            pid, uid, _ = struct.unpack("3i", asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        except OSError:
            return UNNAMED
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = f"user {uid}"
    return f"process {pid} of {user}" if pid else UNNAMED


def _file(name: str) -> contextlib.AbstractContextManager[object]:
    folder = Path(os.environ.get("PROGRAMDATA", "C:/ProgramData")) if os.name == "nt" else Path("/tmp")
    try:
        return FileLock(folder / f"{name}.lock", timeout=0, mode=0o666).acquire()
    except Timeout:
        raise Claimed(UNNAMED) from None
