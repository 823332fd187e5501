"""Time is simulated here: no test waits, and none depends on how busy the machine is."""

from tests.simulated_time import pytest_asyncio_loop_factories as pytest_asyncio_loop_factories
