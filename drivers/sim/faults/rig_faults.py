"""The faults of one rig: one board for all its servers, and what happens without being asked for."""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from drivers.arcs.codes import SafetyMode
from drivers.sim.arcs.power import EMERGENCY_STOPS
from drivers.sim.arcs.rtde_server import RtdeServer
from drivers.sim.arcs.server import ArcsServer
from drivers.sim.camera.mjpeg_server import MjpegServer
from drivers.sim.faults.board import FaultBoard
from drivers.sim.faults.truth import Truth
from drivers.sim.faults.vocabulary import Device, Fault
from drivers.sim.world import World

TICK_S = 0.002
IDLE_TICK_S = 0.02


class Failing(Protocol):
    """A simulated instrument that keeps its own list of faults: `PtyLine`, `ForceBoard`, `SimForceSensor`."""

    def fail(self, *faults: Any) -> None:
        """Let the next requests or rounds meet these, one each."""
        ...


class Faults:
    """Puts one board in every server of a rig, watches for faults that begin by themselves, and is the person there.

    `ink` and `force` are None in a rig without them; faults of theirs are refused then.
    """

    def __init__(
        self,
        world: World,
        arcs: ArcsServer,
        rtde: RtdeServer,
        camera: MjpegServer,
        *,
        ink: Failing | None = None,
        force: Failing | None = None,
    ) -> None:
        self.truth = Truth(world)
        self.board = FaultBoard(self.truth)
        self._world = world
        self._arcs = arcs
        arcs.faults = rtde.faults = camera.faults = self.board
        self._instruments: dict[Device, Failing | None] = {Device.INK: ink, Device.FORCE: force}
        self._watching: asyncio.Task[None] | None = None

    def hang(self, fault: Fault) -> int:
        """Hang one; returns its number. Raises ValueError for a device that the rig does not have."""
        if fault.device in self._instruments and self._instruments[fault.device] is None:
            raise ValueError(f"device = {fault.device.value!r}: this rig has none")
        return self.board.hang(fault)

    def start(self) -> None:
        """Watch, from the running event loop on."""
        self._watching = asyncio.create_task(self._watch(), name="faults")

    async def stop(self) -> None:
        """End watching; what hangs stays."""
        task, self._watching = self._watching, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def release(self) -> str:
        """End a safety stop as a person at the arm would; returns what the safety mode was.

        A protective stop is unlocked at the pendant, a safeguard is reset at its input; an emergency stop's button is
        released and the interface board restarted, which leaves the arm without power.
        """
        cabinet = self._arcs.cabinet
        before = cabinet.power.safety
        if before == SafetyMode.PROTECTIVE_STOP:
            cabinet.power.unlock()
        elif before == SafetyMode.SAFEGUARD_STOP:
            cabinet.power.safety = SafetyMode.NORMAL
        elif before in EMERGENCY_STOPS:
            cabinet.power.button_down = False
            cabinet.power.restart_interface_board()
        return before.value

    def fresh_sheet(self) -> None:
        """Put a blank sheet in."""
        self._world.fresh_sheet()

    def state(self) -> dict[str, Any]:
        """What the world knows now, as JSON."""
        cabinet = self._arcs.cabinet
        x_mm, y_mm, z_mm = self._world.tool().position_mm
        return {
            "now_s": round(self.truth.now_s(), 3),
            "phase": self.truth.phase().value,
            "moving": self.truth.target() is not None,
            "tip_mm": [round(x_mm, 3), round(y_mm, 3), round(z_mm, 3)],
            "presses": self.truth.presses,
            "ink_load": round(self._world.ink_load, 3),
            "robot_mode": cabinet.power.mode.value,
            "safety_mode": cabinet.power.safety.value,
            "faults": len(self.board.hanging),
        }

    async def _watch(self) -> None:
        while True:
            waits = self.board.waits_by_itself
            for fault in self.board.due() if waits else ():
                self._begin(fault)
            await asyncio.sleep(TICK_S if waits else IDLE_TICK_S)

    def _begin(self, fault: Fault) -> None:
        instrument = self._instruments.get(fault.device)
        if instrument is None:
            self._arcs.stop_as(fault.kind)
            return
        instrument.fail(*[_name_of(fault)] * (fault.strikes or 1))


def _name_of(fault: Fault) -> Any:
    """The member of the instrument's own enumeration."""
    # Here, because python-can takes a while to import, and a rig without a force sensor does not need it.
    if fault.device is Device.INK:
        from drivers.sim.instruments.ink_station import Fault as Names
    else:
        from drivers.sim.instruments.force_board import Fault as Names
    return Names[fault.kind.upper().replace("-", "_")]
