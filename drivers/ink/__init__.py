"""Ink devices on a serial line: a station with a documented line protocol, and a peristaltic pump on Modbus RTU.

The engine, the plan and the first day use what `InkTable` and `InkDevice` say of any of them; a new device is one more
file here and its table in `AnyInkTable`. `simulator` is used by the loopback rig and tests alone.
"""

from typing import Annotated

from pydantic import Field

from brushloop.drivers.ink.pump import ModbusPumpConfig
from brushloop.drivers.ink.station import InkStationConfig

AnyInkTable = Annotated[InkStationConfig | ModbusPumpConfig, Field(discriminator="kind")]
