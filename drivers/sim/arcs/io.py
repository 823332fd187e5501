"""The loopback cabinet's inputs and outputs: levels that stay where they are put, and pulses that end by themselves."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeGuard

from drivers.arcs.codes import ReturnCode

Params = dict[str, Any]

DIGITAL = {"Standard": (16, 8), "Configurable": (16, 16), "Tool": (4, 4)}
"""Inputs and outputs by place, as in the examples of the SDK's headers."""
ANALOG = {"Standard": (2, 2), "Tool": (2, 0)}
ANALOG_DOMAINS = (0, 4, 5, 8, 10)
"""Accepted and kept; what each stands for on a terminal is not simulated."""


class Io:
    """IO at the cabinet and the tool. Tests and rigs set `inputs` and `analog_inputs`; clients set outputs."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._outputs = {place: [False] * outs for place, (_, outs) in DIGITAL.items()}
        self.inputs = {place: [False] * ins for place, (ins, _) in DIGITAL.items()}
        self.analog_outputs = {place: [0.0] * outs for place, (_, outs) in ANALOG.items()}
        self.analog_inputs = {place: [0.0] * ins for place, (ins, _) in ANALOG.items()}
        self.tool_is_input = [True] * 4
        self.tool_volts = 0
        self._pulses: dict[tuple[str, int], float] = {}
        """When each pulse ends, by place and index."""

    @property
    def outputs(self) -> dict[str, list[bool]]:
        """Digital outputs by place, now."""
        now_s = self._now_s()
        for (place, index), end_s in list(self._pulses.items()):
            if end_s <= now_s:
                del self._pulses[place, index]
                self._outputs[place][index] = not self._outputs[place][index]
        return self._outputs

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """By `IoControl.method`."""
        table: dict[str, Callable[[Params], Any]] = {
            "IoControl.setToolIoInput": lambda p: _put(self.tool_is_input, p["index"], p["input"]),
            "IoControl.isToolIoInput": lambda p: _level(self.tool_is_input, p["index"]),
            "IoControl.setToolVoltageOutputDomain": lambda p: self._set_volts(p["domain"]),
            "IoControl.getToolVoltageOutputDomain": lambda _: self.tool_volts,
            "IoControl.hasEncoderSensor": lambda _: False,
        }
        for place in DIGITAL:
            table |= self._digital(place)
        for place in ANALOG:
            table |= _analog(f"{place}AnalogInput", self.analog_inputs[place])
            table |= _analog(f"{place}AnalogOutput", self.analog_outputs[place])
            table[f"IoControl.set{place}AnalogOutput"] = lambda p, o=self.analog_outputs[place]: _put_number(
                o, p["index"], p["value"]
            )
        return table

    def _digital(self, place: str) -> dict[str, Callable[[Params], Any]]:
        name, inputs = f"{place}Digital", self.inputs[place]
        return {
            f"IoControl.set{name}Output": lambda p: self._put(place, p["index"], p["value"]),
            f"IoControl.set{name}OutputPulse": lambda p: self._pulse(place, p["index"], p["value"], p["duration"]),
            f"IoControl.get{name}Output": lambda p: _level(self.outputs[place], p["index"]),
            f"IoControl.get{name}Outputs": lambda _: mask(self.outputs[place]),
            f"IoControl.get{name}OutputNum": lambda _: len(self._outputs[place]),
            f"IoControl.get{name}Input": lambda p: _level(inputs, p["index"]),
            f"IoControl.get{name}Inputs": lambda _: mask(inputs),
            f"IoControl.get{name}InputNum": lambda _: len(inputs),
        }

    def _put(self, place: str, index: object, value: object) -> int:
        code = _put(self.outputs[place], index, value)
        if code == ReturnCode.OK:
            self._pulses.pop((place, int(str(index))), None)
        return code

    def _pulse(self, place: str, index: object, value: object, duration_s: float) -> int:
        """Put the level; the other one comes back after `duration_s` of simulated time."""
        if not (math.isfinite(duration_s) and duration_s > 0.0):
            return -ReturnCode.INVALID_ARGUMENT
        code = self._put(place, index, value)
        if code == ReturnCode.OK:
            self._pulses[place, int(str(index))] = self._now_s() + duration_s
        return code

    def _set_volts(self, volts: object) -> int:
        if volts not in (0, 12, 24):
            return -ReturnCode.INVALID_ARGUMENT
        self.tool_volts = int(str(volts))
        return ReturnCode.OK


def mask(levels: list[bool]) -> int:
    """Bit i is level i."""
    return sum(1 << i for i, level in enumerate(levels) if level)


def _analog(name: str, values: list[float]) -> dict[str, Callable[[Params], Any]]:
    domains: list[int] = [0] * len(values)

    def set_domain(p: Params) -> int:
        index, domain = p["index"], p["domain"]
        if not _is_index(index, values) or domain not in ANALOG_DOMAINS:
            return -ReturnCode.INVALID_ARGUMENT
        domains[index] = domain
        return ReturnCode.OK

    return {
        f"IoControl.get{name}": lambda p: values[p["index"]] if _is_index(p["index"], values) else 0.0,
        f"IoControl.get{name}Num": lambda _: len(values),
        f"IoControl.get{name}Domain": lambda p: domains[p["index"]] if _is_index(p["index"], values) else 0,
        f"IoControl.set{name}Domain": set_domain,
    }


def _is_index(index: Any, values: list[Any]) -> TypeGuard[int]:
    return isinstance(index, int) and not isinstance(index, bool) and 0 <= index < len(values)


def _put(levels: list[bool], index: object, value: object) -> int:
    if not isinstance(index, int) or not isinstance(value, bool) or not 0 <= index < len(levels):
        return -ReturnCode.INVALID_ARGUMENT
    levels[index] = value
    return ReturnCode.OK


def _put_number(values: list[float], index: Any, value: Any) -> int:
    if not _is_index(index, values) or not isinstance(value, int | float) or not math.isfinite(value):
        return -ReturnCode.INVALID_ARGUMENT
    values[index] = float(value)
    return ReturnCode.OK


def _level(levels: list[bool], index: object) -> bool:
    return isinstance(index, int) and 0 <= index < len(levels) and levels[index]
