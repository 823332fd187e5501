"""Fixtures for a lab's own tests: `brushloop_rig` and `brushloop_twin`, loaded by pytest where brushloop is installed.

Each is a loopback rig in a process of its own, which ends with the test. Nothing that it presses is a result on paper.
"""

from collections.abc import Generator
from pathlib import Path

import pytest

from brushloop.drivers.loopback import simulate

TWIN_INI = "brushloop_twin"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the ini option that names the twin."""
    parser.addini(TWIN_INI, "twin.toml that the fixture `brushloop_twin` presses with", type="paths")


@pytest.fixture
def brushloop_rig(tmp_path: Path) -> Generator[Path]:
    """`rig.toml` of a running loopback rig with the default brush."""
    with simulate(tmp_path) as rig:
        yield rig.config


@pytest.fixture
def brushloop_twin(tmp_path: Path, request: pytest.FixtureRequest) -> Generator[Path]:
    """`rig.toml` of a running loopback rig that presses with the twin which the ini option `brushloop_twin` names."""
    named: list[Path] = request.config.getini(TWIN_INI)
    if len(named) != 1:
        raise pytest.UsageError(f"{TWIN_INI}: name one twin.toml in pytest's settings; `brushloop twin` makes it")
    with simulate(tmp_path, brush=str(named[0])) as rig:
        yield rig.config
