"""Serial instruments on a pty: the ink station's firmware, and the line and faults that all simulated ones share."""

from __future__ import annotations

import contextlib
import os
import select
import tempfile
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink.station import number_of, seal, unseal
from brushloop.drivers.sim.faults.kinds import InkFault
from brushloop.drivers.sim.world import Well

GARBAGE = b"\xff\x00*\n\x86\x01ok 1*0000\n"
BYTE_S = 0.001


class Instrument(Protocol):
    """The device at the other end of the line; bytes in, bytes out."""

    def take(self, buffer: bytearray) -> bytes | None:
        """Remove one request from the buffer; None while it is incomplete."""
        ...

    def answer(self, request: bytes) -> bytes | None:
        """Carry out the request and reply; None for silence."""
        ...

    def damage(self, reply: bytes) -> bytes:
        """The reply with a wrong checksum."""
        ...

    def mistake(self, reply: bytes) -> bytes:
        """A valid reply, but not to this request."""
        ...


class PtyLine:
    """An instrument on a pseudo terminal, served by a thread; open `path` as the serial port.

    `path` is a link of its own that goes with the cable, as udev's do: the kernel gives the number of a closed
    terminal to the next one, so a driver that connects again by number would reach another instrument.
    """

    def __init__(self, instrument: Instrument, *, late_s: float = 0.3) -> None:
        self.instrument = instrument
        self.path = ""
        self._late_s = late_s
        self.next_fault: Callable[[], InkFault | None] = lambda: None
        """Asked in the instrument's thread for the fault of each request."""
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._wake: tuple[int, int] = (-1, -1)
        self._link: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> Self:
        """Open the pty and serve it."""
        master, slave = os.openpty()
        tty.setraw(slave)  # or the terminal would echo, and translate line ends
        self._link = tempfile.TemporaryDirectory(prefix="brushloop-line-")
        link = Path(self._link.name) / "tty"
        link.symlink_to(os.ttyname(slave))
        self.path = str(link)
        self._wake = os.pipe()
        self._stopping.clear()
        self._thread = threading.Thread(target=self._serve, args=(master, slave), name="pty instrument", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Join the thread and close the pty; harmless where it was never opened."""
        self.unplug()
        for end in self._wake:
            if end >= 0:
                os.close(end)
        self._wake = (-1, -1)
        if self._link is not None:
            self._link.cleanup()
            self._link = None

    def unplug(self) -> None:
        """Pull the cable now; returns when the port is gone."""
        self._stopping.set()
        if self._thread is not None:
            os.write(self._wake[1], b"x")
            self._thread.join()
            self._thread = None

    def _serve(self, master: int, slave: int) -> None:
        buffer = bytearray()
        try:
            while not self._stopping.is_set():
                ready, _, _ = select.select([master, self._wake[0]], [], [])
                if self._wake[0] in ready:
                    break
                buffer += os.read(master, 4096)
                while (request := self.instrument.take(buffer)) is not None:
                    self._meet(master, request)
        finally:
            Path(self.path).unlink(missing_ok=True)
            os.close(slave)
            os.close(master)

    def _meet(self, master: int, request: bytes) -> None:
        fault = self.next_fault()
        if fault is InkFault.UNPLUG:
            self._stopping.set()
            return
        reply = None if fault is InkFault.DEAF else self.instrument.answer(request)
        if reply is None:
            return
        match fault:
            case InkFault.MUTE:
                reply = b""
            case InkFault.GARBAGE:
                reply = GARBAGE
            case InkFault.LATE:
                self._stopping.wait(self._late_s)
            case InkFault.SPLIT:
                for index in range(len(reply) - 1):
                    os.write(master, reply[index : index + 1])
                    self._stopping.wait(BYTE_S)
                reply = reply[-1:]
            case InkFault.DAMAGED:
                reply = self.instrument.damage(reply)
            case InkFault.MISTAKEN:
                reply = self.instrument.mistake(reply)
            case InkFault.ECHO:
                reply = request
            case _:
                pass
        with contextlib.suppress(OSError):
            os.write(master, reply)


class StationFirmware:
    """The ink station's side of docs/ink-station.md, with a well, a reservoir, a light and a lid."""

    def __init__(self, well: Well | None = None, reservoir_ml: float = 100.0) -> None:
        self.well = well or Well(10.0, capacity_ml=20.0)
        self.reservoir_ml = reservoir_ml
        self.light = 0.0
        self.lid_open = True
        self._memory: tuple[bytes, bytes] = (b"", b"")

    def take(self, buffer: bytearray) -> bytes | None:
        """One line."""
        end = buffer.find(b"\n") + 1
        if not end:
            return None
        line = bytes(buffer[:end])
        del buffer[:end]
        return line

    def answer(self, request: bytes) -> bytes | None:
        """The reply; a repeated line is answered from memory, a damaged one not at all."""
        if request == self._memory[0]:
            return self._memory[1]
        try:
            line = unseal(request)
        except ProtocolViolation:
            return None  # the number that it carries cannot be trusted
        try:
            text = self._obey(line.text.split(" "))
        except ProtocolViolation:
            text = "err 2 not a number"
        reply = seal(line.number, text)
        self._memory = (request, reply)
        return reply

    def damage(self, reply: bytes) -> bytes:
        """One character of the checksum changed."""
        return reply[:-2] + (b"0" if reply[-2:-1] != b"0" else b"1") + b"\n"

    def mistake(self, reply: bytes) -> bytes:
        """A reply with the number of the previous request."""
        line = unseal(reply)
        return seal((line.number - 1) % 1000, line.text)

    def _obey(self, words: list[str]) -> str:
        match words:
            case ["identify"]:
                return "ok ink-station 1 1.0.0 loopback"
            case ["dose", volume]:
                return self._dose(number_of(volume))
            case ["light", level]:
                if number_of(level) > 1.0:
                    return "err 2 light goes to 1"
                self.light = number_of(level)
                return "ok"
            case ["lid", ("open" | "close") as word]:
                self.lid_open = word == "open"
                return "ok"
            case ["level"]:
                return f"ok {self.well.share:.3f}"
            case _:
                return "err 1 unknown command"

    def _dose(self, volume_ml: float) -> str:
        if not self.lid_open:
            return "err 5 lid is closed"
        if volume_ml > self.reservoir_ml:
            return "err 4 reservoir is empty"
        if self.well.ml + volume_ml > self.well.capacity_ml:
            return "err 3 well would overflow"
        self.reservoir_ml -= volume_ml
        self.well.add(volume_ml)
        return f"ok {volume_ml:.3f}"
