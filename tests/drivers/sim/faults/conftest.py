"""Waits of the arm's driver are cut short: the faults of these tests last, and the loopback's arm rests soon."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest

from brushloop.drivers.arcs import stopping
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig

RPC_TIMEOUT_S = 0.4


@pytest.fixture(autouse=True)
def impatient() -> Iterator[None]:
    # A patch of its own: `monkeypatch` would be undone after the arm is closed, and tests rely on its being before.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stopping, "CONFIRM_S", 1.5)
        patch.setitem(RpcConnection.__init__.__kwdefaults__, "timeout_s", RPC_TIMEOUT_S)
        yield


@pytest.fixture
async def rig(small_view: View) -> AsyncIterator[LoopbackRig]:
    """Everything that a rig has, 20 times faster than life."""
    async with LoopbackRig(SimConfig(rate=20.0, view=small_view)) as it:
        yield it
