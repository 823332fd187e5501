"""The loopback cabinet's digital inputs and outputs: levels that stay where they are put."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import ReturnCode

Params = dict[str, Any]


class DigitalIo:
    """Standard and tool IO. Tests set `inputs`; clients set outputs."""

    def __init__(self) -> None:
        self.outputs: dict[str, list[bool]] = {"Standard": [False] * 8, "Tool": [False] * 4}
        self.inputs: dict[str, list[bool]] = {"Standard": [False] * 16, "Tool": [False] * 4}
        self.tool_is_input = [True] * 4
        self.tool_volts = 0

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """By `IoControl.method`."""
        table: dict[str, Callable[[Params], Any]] = {
            "IoControl.setToolIoInput": lambda p: _put(self.tool_is_input, p["index"], p["input"]),
            "IoControl.isToolIoInput": lambda p: _level(self.tool_is_input, p["index"]),
            "IoControl.setToolVoltageOutputDomain": lambda p: self._set_volts(p["domain"]),
            "IoControl.getToolVoltageOutputDomain": lambda _: self.tool_volts,
        }
        for place in ("Standard", "Tool"):
            outputs, inputs = self.outputs[place], self.inputs[place]
            digital = f"{place}Digital"
            table |= {
                f"IoControl.set{digital}Output": lambda p, o=outputs: _put(o, p["index"], p["value"]),
                f"IoControl.get{digital}Output": lambda p, o=outputs: _level(o, p["index"]),
                f"IoControl.get{digital}Outputs": lambda _, o=outputs: mask(o),
                f"IoControl.get{digital}OutputNum": lambda _, o=outputs: len(o),
                f"IoControl.get{digital}Input": lambda p, i=inputs: _level(i, p["index"]),
                f"IoControl.get{digital}Inputs": lambda _, i=inputs: mask(i),
                f"IoControl.get{digital}InputNum": lambda _, i=inputs: len(i),
            }
        return table

    def _set_volts(self, volts: object) -> int:
        if volts not in (0, 12, 24):
            return -ReturnCode.INVALID_ARGUMENT
        self.tool_volts = int(str(volts))
        return ReturnCode.OK


def mask(levels: list[bool]) -> int:
    """Bit i is level i."""
    return sum(1 << i for i, level in enumerate(levels) if level)


def _put(levels: list[bool], index: object, value: object) -> int:
    if not isinstance(index, int) or not isinstance(value, bool) or not 0 <= index < len(levels):
        return -ReturnCode.INVALID_ARGUMENT
    levels[index] = value
    return ReturnCode.OK


def _level(levels: list[bool], index: object) -> bool:
    return isinstance(index, int) and 0 <= index < len(levels) and levels[index]
