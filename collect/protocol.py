"""The grid under its old names; any protocol is in `collect.protocols.plans`."""

from __future__ import annotations

from collect.protocols.grid import planned as plan_grid
from collect.protocols.grid import steps as grid
from collect.protocols.planned import Planned

__all__ = ["Planned", "grid", "plan_grid"]
