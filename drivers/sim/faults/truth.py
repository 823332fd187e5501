"""What faults may look at: the world's own clock, its arm and its paper."""

from __future__ import annotations

from drivers.samples import Pose
from drivers.sim.faults.phases import Phase, Spot, phase_of
from drivers.sim.world import World


class Truth:
    """One world, seen by what a fault may wait for. To be asked in the thread that owns the world."""

    def __init__(self, world: World) -> None:
        self._world = world

    def now_s(self) -> float:
        """Simulated seconds since the rig started."""
        return self._world.clock.now_s()

    @property
    def presses(self) -> int:
        """Marks on the paper so far: the index of the press to come."""
        return len(self._world.presses)

    def target(self) -> Pose | None:
        """Where the piece of the path that runs now ends; None at rest."""
        queue = self._world.motion
        queue.advance(self.now_s())
        line = queue.running
        return None if line is None else line.pose(line.end_s)

    def phase(self) -> Phase:
        """What the arm does now."""
        config, to = self._world.config, self.target()
        return phase_of(
            config.table,
            self._spot(*config.home_mm),
            self._spot(*self._world.tool().position_mm),
            None if to is None else self._spot(*to.position_mm),
        )

    def _spot(self, x_mm: float, y_mm: float, z_mm: float) -> Spot:
        return Spot(*self._world.to_paper(x_mm, y_mm), z_mm - self._world.config.table.paper_z_mm)
