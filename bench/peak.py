"""Time and peak memory of a command, by the operating system's account of its process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from bench.harness import BenchError

# The kernel charges a process with what it held before `exec`, so a command that is started from here would be charged
# with the bench's own memory. A small interpreter of about 10 MB starts it instead.
_STARTER = """
import json, os, sys, time
began = time.monotonic()
child = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
_, status, used = os.wait4(child, 0)
taken = time.monotonic() - began, used.ru_utime + used.ru_stime, used.ru_maxrss, os.waitstatus_to_exitcode(status)
os.write(int(sys.argv[1]), json.dumps(taken).encode())
"""


@dataclass(frozen=True, slots=True)
class Used:
    """What a command took: wall and CPU seconds of all its threads, and the most memory that it held, MB (10^6)."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def measure(*command: str, code: int = 0, cwd: Path | None = None) -> Used:
    """Run a command to its end. Raises BenchError with its last words if its exit code is not `code`."""
    read, write = os.pipe()
    starter = [sys.executable, "-I", "-S", "-c", _STARTER, str(write), *command]
    ran = subprocess.run(starter, capture_output=True, text=True, check=False, pass_fds=(write,), cwd=cwd)
    os.close(write)
    with os.fdopen(read) as pipe:
        answer = pipe.read()
    if not answer:
        raise BenchError(f"{command[0]} could not be started: {ran.stderr[-300:]}")
    wall_s, cpu_s, peak_kib, ended = json.loads(answer)
    if ended != code:
        raise BenchError(f"`{' '.join(command)}` ended with {ended}: {(ran.stderr or ran.stdout)[-300:]}")
    return Used(wall_s, cpu_s, peak_kib * 1024 / 1e6)
