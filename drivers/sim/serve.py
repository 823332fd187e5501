"""The rig as a process: it serves until a signal or until idle, writes its `rig.toml`, and may be controlled live."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from brushloop.drivers.sim.brush.spec import SimFileError
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.control import live_control
from brushloop.drivers.sim.rig import LOOPBACK_HEAD, LoopbackRig


def serve(
    config: SimConfig,
    write_rig: Path | None,
    idle_exit_s: float,
    tell: Callable[[str], None] = lambda _text: None,
    *,
    control: Path | None = None,
) -> None:
    """Serve until a signal, or until idle for `idle_exit_s` (0 means never).

    Raises `SimFileError` for a control socket that cannot be created, and rather than overwrite a file that no loopback
    rig wrote.
    """

    async def served() -> None:
        over = _signalled()
        if write_rig is not None:
            _refuse_to_overwrite(write_rig)
        async with LoopbackRig(config) as rig, live_control(rig, control):
            if write_rig is not None:
                _write_whole(write_rig, rig.toml())
            tell(f"{rig.where()}; Ctrl-C ends")
            await _until_over(rig, over, idle_exit_s)

    asyncio.run(served())


def serve_unknown(
    seed: int,
    trap: str | None,
    rate: float,
    idle_exit_s: float,
    tell: Callable[..., None],
    *,
    truth: Path | None = None,
    control: Path | None = None,
) -> None:
    """Serve the unknown lab of this seed and print what a person sees there; its truth goes to the file `truth`.

    Raises `LabRefused` for an unknown trap or a file that cannot be written, and `SimFileError` for the control socket.
    """
    from brushloop.drivers.sim.lab.facts import Trap
    from brushloop.drivers.sim.lab.lab import UnknownLab
    from brushloop.drivers.sim.lab.lab import truth as truth_of

    if trap is not None and trap not in [*Trap]:
        raise LabRefused(f"--trap is {trap!r}, allowed: {', '.join(Trap)}")
    if truth is not None and truth.exists() and b'"seed"' not in truth.read_bytes()[:100]:
        raise LabRefused(f"{truth}: exists and is not the truth of a lab; it is not overwritten")
    lab = UnknownLab(seed, None if trap is None else Trap(trap), rate=rate)

    def write_truth() -> None:
        if truth is not None:
            _write_whole(truth, json.dumps(truth_of(lab.facts, lab.trap), indent=1) + "\n")

    async def obey(request: Mapping[str, object]) -> dict[str, Any]:
        answer = await lab.obey(request)
        write_truth()  # what was mended is no longer as it was
        return answer

    async def served() -> None:
        over = _signalled()
        async with lab, live_control(lab.rig, control, obey):
            write_truth()
            how = [] if control is None else [f"hand      brushloop hand {control} bring pin"]
            tell(*lab.seen().lines(), *how, "Ctrl-C ends")
            await _until_over(lab.rig, over, idle_exit_s)

    asyncio.run(served())


def _signalled() -> asyncio.Event:
    """An event that SIGINT (Ctrl-C) and SIGTERM set."""
    over, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, over.set)
    return over


async def _until_over(rig: LoopbackRig, over: asyncio.Event, idle_exit_s: float) -> None:
    """Serve until the event is set or no client was connected for `idle_exit_s`; SIGUSR1 changes the sheet."""
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, rig.world.fresh_sheet)
    waits: list[asyncio.Task[object]] = [asyncio.create_task(over.wait())]
    if idle_exit_s > 0:
        waits.append(asyncio.create_task(rig.idle(idle_exit_s)))
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    for wait in waits:
        wait.cancel()
    await asyncio.gather(*waits, return_exceptions=True)


class LabRefused(Exception):
    """No such lab can be served, or its truth cannot be written."""

    exit_code: ClassVar[int] = 2


def _refuse_to_overwrite(path: Path) -> None:
    if not path.parent.is_dir():
        raise SimFileError(path, "", f"there is no folder {path.parent}")
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(LOOPBACK_HEAD.encode())):
        raise SimFileError(path, "", "exists and was not written by a loopback rig; it is not overwritten")


def _write_whole(path: Path, text: str) -> None:
    """Write the file so that a reader sees all of it or none."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
