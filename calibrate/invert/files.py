"""The files of an inversion: a CSV of what was recovered, and the protocol that presses it again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.calibrate.invert.invert import Inversion
from brushloop.sessions.disk import csv_text

PROTOCOL = "protocol-replay.toml"
MAX_ROWS = 10_000
COLUMNS = (
    "stroke_id", "depth_mm", "tilt_deg", "depth_sd_mm", "tilt_sd_deg", "rms", "flags",
    "commanded_depth_mm", "commanded_tilt_deg", "source",
)  # fmt: skip


def write_inversion(made: Inversion, out: Path, repeats: int = 1, seed: int = 1) -> Path:
    """Write `out` and the protocol beside it, which presses each stroke `repeats` times in an order drawn with `seed`.

    Returns the protocol's path. Raises `CalibrationError` and OSError.
    """
    if not made.rows:
        why = f": {made.refused[0][0]}: {made.refused[0][1]}" if made.refused else ""
        raise CalibrationError(str(made.recording), f"no stroke could be recovered{why}")
    if len(made.rows) * repeats > MAX_ROWS:
        problem = f"{len(made.rows) * repeats} strokes with repeats, a protocol holds at most {MAX_ROWS}"
        raise CalibrationError(str(made.recording), problem)
    if out.name == PROTOCOL or not out.name.isprintable() or "\\" in out.name or len(out.name) > 200:
        raise CalibrationError(str(out), "a protocol cannot name this file: give a plain name, as recovered.csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, csv_text(COLUMNS, csv_rows(made)))
    protocol = out.parent / PROTOCOL
    write_whole(protocol, replay_toml(made, out.name, repeats, seed))
    return protocol


def csv_rows(made: Inversion) -> Iterator[list[str]]:
    """One row per stroke; depths and tilts to three decimals, deviations to three figures."""
    for row in made.rows:
        asked = ["" if v is None else f"{v:g}" for v in (row.commanded_depth_mm, row.commanded_tilt_deg)]
        numbers = [f"{row.depth_mm:.3f}", f"{row.tilt_deg:.3f}", f"{row.depth_sd_mm:.3g}", f"{row.tilt_sd_deg:.3g}"]
        yield [row.stroke_id, *numbers, f"{row.rms:.4f}", " ".join(row.flags), *asked, str(made.header.source)]


def replay_toml(made: Inversion, name: str, repeats: int = 1, seed: int = 1) -> str:
    """The `replay` protocol for the CSV file `name`."""
    return (
        f"# Recovered by {made.settings.model} from {made.header.session_id} ({made.header.source}), "
        f"recording sha256 {made.recording_sha256}.\n"
        'kind = "replay"\n'
        f"of = {json.dumps(made.header.session_id, ensure_ascii=False)}\n"
        f"file = {json.dumps(name, ensure_ascii=False)}\n"
        f"repeats = {repeats}\n"
        f"seed = {seed}\n"
    )
