"""The lines of a journal as the JSON that they hold, for tests that look at single fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from brushloop.sessions.journal import undamaged

CHECKS = ("seq", "session", "crc")


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Complete lines, without the fields by which they are checked."""
    complete = len(undamaged(path).events)
    for line in path.read_bytes().splitlines()[:complete]:
        yield {name: value for name, value in json.loads(line).items() if name not in CHECKS}
