"""A thread that owns a CAN bus from open to shutdown and turns its frames into wrenches."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from brushloop.drivers.clock import Clock
from brushloop.drivers.force.rounds import (
    BITRATE,
    BUS_OFF,
    COMMAND_ID,
    LOOPBACK_CHANNEL,
    START,
    STOP,
    RoundAssembler,
    Wrench,
)
from brushloop.drivers.samples import Stamp

if TYPE_CHECKING:
    import can

RECEIVE_S = 0.05
RATE_WINDOW = 200
SILENT_S = 1.0
"""A board that streamed and then sends nothing for this long is lost: a gateway that goes away gives no notice."""


@dataclass(frozen=True, slots=True)
class SriOptions:
    """Which bus the board is on, and which samples to accept."""

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = BITRATE
    host: str | None = None
    """Address of a CAN gateway, for the interface `socketcand`."""
    port: int | None = None
    stale_after_ms: float = 100.0
    stuck_after_ms: float = 100.0
    """Time over which rounds that are equal to the last bit in all six values mean a stuck sensor."""
    connect_timeout_s: float = 2.0
    round_ms: float = 5.0
    """Longest time from the first to the third frame of a round. It must be shorter than the sensor's period:
    otherwise two rounds that each lost frames can pass for one."""
    max_n: float = 1000.0
    max_nm: float = 100.0
    """Values beyond what the sensor can measure are refused like NaN."""
    still_n: float = 0.05
    still_nm: float = 0.01
    """The largest standard deviation, in each axis, at which the sensor counts as still."""


@dataclass(frozen=True, slots=True)
class ForceHealth:
    """Statistics of the stream since `connect`."""

    rate_hz: float
    """Rate of the newest rounds; 0 before the second round."""
    rounds: int
    torn: int
    """Dropped rounds in which a frame was missing, late or malformed."""
    refused: int
    """Dropped complete rounds with NaN, inf or a value beyond the sensor's range."""
    bus_errors: int


@dataclass(frozen=True, slots=True)
class Loss:
    """Why the stream ended and what to do about it."""

    what: str
    remedy: str


class RoundStream:
    """Starts the sensor, reads it until `stop`, and stops it again. Use one for each connection."""

    def __init__(
        self,
        options: SriOptions,
        clock: Clock,
        *,
        on_round: Callable[[Stamp, Wrench], None],
        on_loss: Callable[[], None],
    ) -> None:
        self._options = options
        self._assembler = RoundAssembler(round_ms=options.round_ms, max_n=options.max_n, max_nm=options.max_nm)
        self._clock = clock
        self._on_round = on_round
        self._on_loss = on_loss
        self._closing = threading.Event()
        self._arrivals_ns: deque[int] = deque(maxlen=RATE_WINDOW)
        self._rounds = self._bus_errors = 0
        self.newest: tuple[Stamp, Wrench] | None = None
        self.alike = 0
        """Number of newest rounds in a row that exactly equal the one before; a strain gauge is never that still."""
        self.alike_since_ns = 0
        """Time at which the first round equal to the newest arrived."""
        self.loss: Loss | None = None
        self.channel_info = ""
        self.virtual = False
        self.collecting: list[Wrench] | None = None
        """Collects every round while an average is taken."""
        self._thread = threading.Thread(target=self._run, name="force reader", daemon=True)

    def start(self) -> None:
        """Open the bus and read it, in a thread; a failure is stored in `loss`."""
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop the sensor, shut the bus down, join the thread; blocks."""
        self._closing.set()
        self._thread.join(timeout_s)

    def health(self) -> ForceHealth:
        """Rate and counters."""
        arrivals_ns = self._arrivals_ns.copy()
        span_ns = arrivals_ns[-1] - arrivals_ns[0] if len(arrivals_ns) > 1 else 0
        rate_hz = (len(arrivals_ns) - 1) * 1e9 / span_ns if span_ns else 0.0
        parts = self._assembler
        return ForceHealth(rate_hz, self._rounds, parts.torn, parts.refused, self._bus_errors)

    def _run(self) -> None:
        try:
            import can  # slow to import, and most rigs have no such sensor

            bus = self._open()
        except Exception as error:
            # Back ends raise arbitrary exceptions if a library or a package is missing.
            self._lose(f"cannot open {self._name}: {error}", "Check the adapter and that its interface is up.")
            return
        try:
            self.channel_info, self.virtual = str(bus.channel_info), _is_virtual(self._options)
            bus.send(command(START), timeout=1.0)
            heard, quiet_s = False, 0.0
            while self.loss is None and not self._closing.is_set():
                message = bus.recv(RECEIVE_S)
                if message is not None:
                    heard, quiet_s = True, 0.0
                    self._take(message)
                    continue
                # Only time in which the bus was listened to: a computer that was held up has missed nothing.
                quiet_s += RECEIVE_S
                if heard and quiet_s > SILENT_S:
                    self._lose_bus(f"has been silent for {SILENT_S:g} s")
                elif bus.state is can.BusState.ERROR:
                    self._lose_bus("is off")
        except (can.CanError, OSError) as error:
            self._lose_bus(f"failed: {error}")
        finally:
            with contextlib.suppress(can.CanError, OSError):
                bus.send(command(STOP), timeout=1.0)
            bus.shutdown()
            if not self._closing.is_set() and self.loss is None:
                self._lose("the reader failed", "Connect again.")

    def _open(self) -> can.BusABC:
        import can

        options = self._options
        # Use these settings only: python-can would also read can.ini, the environment and the home folder.
        # The library warns of frames that arrive in two pieces, which is harmless; a lost frame shows in the counts.
        logging.getLogger("can").setLevel(logging.ERROR)
        gateway: dict[str, Any] = {} if options.host is None else {"host": options.host, "port": options.port}
        return can.Bus(options.channel, options.interface, ignore_config=True, bitrate=options.bitrate, **gateway)

    def _take(self, message: can.Message) -> None:
        if message.is_error_frame:
            self._bus_errors += 1
            if message.arbitration_id & BUS_OFF:
                self._lose_bus("is off after too many errors")
            return
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return
        wrench = self._assembler.feed(message.arbitration_id, bytes(message.data), message.timestamp)
        if wrench is None:
            return
        device_ns = round(message.timestamp * 1e9) or None  # 0: the adapter has no clock
        now_ns = self._clock.now_ns()
        self._arrivals_ns.append(now_ns)
        stamp = Stamp(now_ns, device_ns, self._rounds)
        self._rounds += 1
        if self.newest is not None and wrench == self.newest[1]:
            self.alike += 1
        else:
            self.alike, self.alike_since_ns = 0, now_ns
        self.newest = (stamp, wrench)
        if (collecting := self.collecting) is not None:
            collecting.append(wrench)
        self._on_round(stamp, wrench)

    @property
    def _name(self) -> str:
        return f"{self._options.interface} {self._options.channel}"

    def _lose_bus(self, what: str) -> None:
        self._lose(
            f"the bus {self._name} {what}",
            f"Check wiring, termination and that both ends run at {self._options.bitrate} bit/s; "
            "then set the interface down and up, and connect again.",
        )

    def _lose(self, what: str, remedy: str) -> None:
        self.loss = Loss(what, remedy)
        self._on_loss()


def command(data: bytes) -> can.Message:
    """Make the CAN frame of a command to the board."""
    import can

    return can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, data=data)


def _is_virtual(options: SriOptions) -> bool:
    return options.interface == "virtual" or (options.interface == "socketcand" and options.channel == LOOPBACK_CHANNEL)
