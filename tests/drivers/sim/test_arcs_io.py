"""Inputs and outputs of the cabinet and the tool."""

from __future__ import annotations

import math
from typing import Any

import pytest

PLACES = {"Standard": (16, 8), "Configurable": (16, 16), "Tool": (4, 4)}


@pytest.mark.parametrize("place", PLACES)
def test_there_are_as_many_as_the_maker_says(on: Any, place: str):
    numbers = tuple(on.ask(f"IoControl.get{place}Digital{way}Num") for way in ("Input", "Output"))
    assert numbers == PLACES[place]


@pytest.mark.parametrize("place", PLACES)
def test_a_pulse_ends_by_itself_and_a_new_level_ends_it_too(on: Any, place: str):
    pulse, level = f"IoControl.set{place}DigitalOutputPulse", f"IoControl.get{place}DigitalOutput"
    assert on.ask(pulse, index=2, value=True, duration=0.5) == 0
    assert on.ask(level, index=2) is True
    on.clock.s += 0.51
    assert on.ask(level, index=2) is False
    on.ask(pulse, index=2, value=True, duration=0.5)
    on.ask(f"IoControl.set{place}DigitalOutput", index=2, value=True)
    on.clock.s += 1.0
    assert on.ask(level, index=2) is True
    for wrong in ({"duration": 0.0}, {"duration": math.nan}, {"index": 99}):
        assert on.ask(pulse, **{"index": 0, "value": True, "duration": 1.0, **wrong}) == -5


def test_analog_outputs_stay_and_inputs_are_the_worlds(on: Any):
    assert on.ask("IoControl.setStandardAnalogOutput", index=1, value=0.5) == 0
    assert on.ask("IoControl.getStandardAnalogOutput", index=1) == 0.5
    for index, value in ((2, 0.5), (0, math.nan), (0, "1"), (-1, 0.5)):
        assert on.ask("IoControl.setStandardAnalogOutput", index=index, value=value) == -5
    assert on.ask("IoControl.setToolAnalogOutput", index=0, value=0.5) == -5, "the tool has none"
    on.cabinet.io.analog_inputs["Tool"][0] = 3.3
    assert on.ask("IoControl.getToolAnalogInput", index=0) == 3.3
    assert on.ask("IoControl.setToolAnalogInputDomain", index=0, domain=10) == 0
    assert on.ask("IoControl.getToolAnalogInputDomain", index=0) == 10
    assert on.ask("IoControl.setToolAnalogInputDomain", index=0, domain=7) == -5


def test_the_supply_of_the_tool_is_one_of_three(on: Any):
    assert on.ask("IoControl.setToolVoltageOutputDomain", domain=24) == 0
    assert on.ask("IoControl.getToolVoltageOutputDomain") == 24
    assert on.ask("IoControl.setToolVoltageOutputDomain", domain=5) == -5
