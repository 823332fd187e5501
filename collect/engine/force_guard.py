"""Watches the force while the brush is down, and stops the arm when it exceeds the ceiling."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine, Generator
from contextlib import contextmanager
from typing import Any, TypeVar

from brushloop.collect.errors import ForceTooHigh, describe
from brushloop.collect.rig.devices import Rig
from brushloop.drivers.devices import ForceSample
from brushloop.drivers.errors import DeviceError, MotionFailed

CHECK_S = 0.02
"""Time between checks for a silent sensor: silence must not be mistaken for zero force."""

_R = TypeVar("_R")


class ForceGuard:
    """Passes on the force sensor's samples, and compares them with `force.max_n`; does nothing without a sensor."""

    def __init__(self, rig: Rig, on_sample: Callable[[ForceSample], None] | None = None) -> None:
        self._rig = rig
        self._listeners = [] if on_sample is None else [on_sample]
        self._over: asyncio.Event = asyncio.Event()
        self._guarding = False
        self.peak_n = 0.0
        """Largest force since `guarded` began."""

    def listen(self) -> None:
        """Begin to accept samples."""
        if self._rig.force is not None:
            self._rig.force.listen(self._sample)

    @contextmanager
    def also(self, on_sample: Callable[[ForceSample], None]) -> Generator[None]:
        """Within the block, pass every sample to one more listener."""
        self._listeners.append(on_sample)
        try:
            yield
        finally:
            self._listeners.remove(on_sample)

    def deafen(self) -> None:
        """Stop accepting samples."""
        if self._rig.force is not None:
            self._rig.force.listen(None)

    async def guarded(self, procedure: Coroutine[Any, Any, _R]) -> _R:
        """Run the procedure while the force is watched.

        Raises `ForceTooHigh` above the ceiling, and `Stale` or `ConnectionLost` if the sensor falls silent; in each
        case the arm is stopped first. Raises `MotionFailed`, which names that cause first, if the stop fails.
        """
        if self._rig.force is None or self._guarding:
            return await procedure
        self._over.clear()
        self.peak_n, self._guarding = 0.0, True
        work, watch = asyncio.ensure_future(procedure), asyncio.create_task(self._watch(), name="force guard")
        try:
            await asyncio.wait((work, watch), return_when=asyncio.FIRST_COMPLETED)
            if watch.done():
                work.cancel()  # or it would send its next line while the arm is being stopped
                try:
                    await self._rig.robot.stop()
                except DeviceError as failure:
                    cause = str(watch.exception()).removesuffix(".")
                    raise MotionFailed(failure.device, failure.op, cause, condition=describe(failure)) from failure
                watch.result()
            return await work
        finally:
            self._guarding = False
            for task in (work, watch):
                task.cancel()
            await asyncio.gather(work, watch, return_exceptions=True)

    async def _watch(self) -> None:
        assert self._rig.force is not None
        assert self._rig.config.force is not None
        while True:
            self._rig.force.latest_n()
            try:
                async with asyncio.timeout(CHECK_S):
                    await self._over.wait()
            except TimeoutError:
                continue
            raise ForceTooHigh(self.peak_n, self._rig.config.force.max_n)

    def _sample(self, sample: ForceSample) -> None:
        if self._guarding and self._rig.config.force is not None:
            self.peak_n = max(self.peak_n, math.hypot(*sample.force_n))
            if self.peak_n > self._rig.config.force.max_n:
                self._over.set()
        for listener in self._listeners:
            listener(sample)
