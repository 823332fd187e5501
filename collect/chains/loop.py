"""One loop, stage by stage: calibrate and fit, recover, press again, calibrate, compare.

What a stage has finished is kept on disk and found again, so that the same command goes on after kill -9. The session
that presses again is an ordinary one of `brushloop collect`, with its safety, its questions and its own resume.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from calibrate.artefact import artefacts, current
from calibrate.files import read_bounded
from collect.chains.commands import GIVEN_UP, Say, run_command
from collect.chains.finished import finished_session
from collect.chains.loop_settings import Settings, begun_with, keep
from collect.errors import ConfigError
from collect.rig.config import RigConfig, load_rig
from sessions.reader import Recording
from sessions.recording.schemas import Header, Source

RECOVERED, PROTOCOL, PAGE = "recovered.csv", "protocol-replay.toml", "loop.html"
FITS = "brushfit"
LEAST_HEIGHT_MM = 2.0
MAX_CSV_BYTES = 8 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asked for."""

    session: Path
    """The original session's folder."""
    config: Path
    out: Path
    fit: Path | None = None
    """The one that the session uses by default; fitted where there is none."""
    repeats: int = 1
    seed: int = 1
    collect_options: tuple[str, ...] = ()
    """Passed to `brushloop collect` as they are: `--arm`, `--sheet 1`, `--no-tui`."""


def run_loop(wanted: Wanted, say: Say) -> Path:
    """Run what is not done yet; returns the report's path. Raises `ConfigError`, `SessionError`, `CommandFailed`."""
    recording = Recording(wanted.session)
    folder, root = recording.path.parent, recording.path.parent.parent
    rig = load_rig(wanted.config)
    _check_rig(wanted.config, rig, recording.header)
    fit = _fit(wanted, recording, say)
    settings = Settings(
        original=recording.header.session_id,
        original_sha256=recording.sha256,
        fit=fit.stem,
        height_range_mm=(LEAST_HEIGHT_MM, rig.brush.max_depth_mm),
        tilt_range_deg=(0.0, rig.robot.limits.tilt_deg),
        repeats=wanted.repeats,
        seed=wanted.seed,
    )
    keep(settings, wanted.out)
    protocol = _recover(wanted, folder, fit, settings, say)
    again = finished_session(root, protocol)
    if again is None:
        options = ("--config", wanted.config, "--protocol", protocol, "--out", root, *wanted.collect_options)
        run_command(say, "collect", *options, accepts=(0, GIVEN_UP))
        again = finished_session(root, protocol)
    if again is None:
        raise ConfigError(root, "", "holds no finished session of the replay, though collection ended")
    if not artefacts(again):
        run_command(say, "calibrate", again)
    run_command(say, "loop", "compare", folder, again, "--fit", fit, "--out", wanted.out)
    return wanted.out / PAGE


def _check_rig(path: Path, rig: RigConfig, header: Header) -> None:
    """Another brush makes other marks: said before anything moves."""
    if header.source is not Source.IMPORT and header.brush != rig.brush.name:
        raise ConfigError(path, "brush.name", f"{rig.brush.name!r}: the original was pressed with {header.brush!r}")


def _fit(wanted: Wanted, recording: Recording, say: Say) -> Path:
    folder = recording.path.parent
    if recording.header.source is not Source.IMPORT and not artefacts(folder):
        run_command(say, "calibrate", folder)
    if wanted.fit is not None:
        return wanted.fit
    if (begun := begun_with(wanted.out)) is not None:
        return folder / FITS / f"{begun.fit}.json"  # whatever was fitted since
    if not artefacts(folder, FITS):
        run_command(say, "fit", folder)
    fit = current(folder, FITS)
    if fit is None:
        raise ConfigError(folder, "", "was not fitted")
    return fit


def _recover(wanted: Wanted, folder: Path, fit: Path, settings: Settings, say: Say) -> Path:
    """Written last, the protocol says that this stage is done."""
    protocol = wanted.out / PROTOCOL
    if not protocol.exists():
        low, high = map(str, settings.height_range_mm)
        options: list[str | Path] = ["--fit", fit, "--height-range", low, high]
        options += ["--tilt-range", *map(str, settings.tilt_range_deg)]
        options += ["--repeats", str(settings.repeats), "--seed", str(settings.seed)]
        run_command(say, "invert", folder, "--out", wanted.out / RECOVERED, *options)
    check_recovered(wanted.out / RECOVERED)
    return protocol


def check_recovered(path: Path) -> None:
    """A model that does not fit this brush must not command it."""
    rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_CSV_BYTES).decode("utf-8"))))
    bound = sum("at_bound" in (row.get("flags") or "") for row in rows)
    if 2 * bound > len(rows):
        told = f"{bound} of {len(rows)} presses were recovered at a bound of the range"
        raise ConfigError(path, "flags", f"{told}: the fit does not describe this brush, nothing is pressed again")
