"""Waits on an engine end, and say what they waited for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.collect.until import until, wait_for_end


def engine(*, finished: bool = False) -> Any:
    calls: list[str] = []
    return SimpleNamespace(
        finished=finished, snapshot=lambda: "pressing", stop=lambda: calls.append("stop"), calls=calls
    )


def test_a_run_that_does_not_end_is_stopped_and_its_state_is_named() -> None:
    endless = engine()
    with pytest.raises(pytest.fail.Exception, match=r"waited 0\.02 s for the end of the run; it is: pressing"):
        wait_for_end(endless, 0.02)
    assert endless.calls == ["stop"]


@pytest.mark.parametrize("finished", [False, True])
def test_a_condition_that_is_not_met_is_named(finished: bool) -> None:
    with pytest.raises(pytest.fail.Exception, match=r"never_so"):
        until(engine(finished=finished), lambda now: now == "never_so", 0.02)
