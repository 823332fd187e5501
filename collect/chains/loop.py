"""`brushloop repress SESSION`, stage by stage: calibrate and fit, recover, press again, calibrate, compare.

The finished work of a stage is kept on disk, so that the same command resumes after kill -9. The session that presses
again is an ordinary one of `brushloop collect`, with the same safety checks, questions and resume.
"""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from brushloop.calibrate.artefact import FITS
from brushloop.calibrate.commands import CompareLoopRequest, RecoverRequest, show_work
from brushloop.calibrate.files import write_whole
from brushloop.collect.chains import LoopRequest
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.open_or_resume import check_fresh_sheet
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.config_file import read_text
from brushloop.collect.start import calibrated, collected_session, fitted
from brushloop.sessions.disk import read_bounded
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import BareName
from brushloop.sessions.terminal import say

SETTINGS, RECOVERED, PROTOCOL, PAGE = "settings.json", "recovered.csv", "protocol-replay.toml", "loop.html"
LEAST_DEPTH_MM = 2.0


def run_loop(request: LoopRequest) -> Path:
    """Run the unfinished stages; return the report's path. Raises `ConfigError`, `SessionError`, `CollectAborted`."""
    recording = Recording(request.session)
    folder, root = recording.path.parent, recording.path.parent.parent
    out = folder / "loop" if request.out is None else request.out
    rig = load_rig(request.config)
    header = recording.header
    if not header.source.imported and header.brush != rig.brush.name:
        # Another brush makes other marks: refused before anything moves.
        was = f"{rig.brush.name!r}, but the session was pressed with {header.brush!r}"
        raise ConfigError(request.config, "brush.name", was)
    if not (out / PROTOCOL).exists():
        check_fresh_sheet(root, request.sheet)  # now, not after minutes of fitting
    if not header.source.imported:
        calibrated(folder)
    wanted = Settings(
        original=header.session_id,
        original_sha256=recording.sha256,
        fit=fitted(folder).stem,
        depth_range_mm=(LEAST_DEPTH_MM, rig.brush.max_depth_mm),
        tilt_range_deg=(0.0, rig.robot.limits.tilt_deg),
        presses=request.presses,
        seed=request.seed,
    )
    settings = begun_with(wanted, out)
    fit = folder / FITS / f"{settings.fit}.json"
    if not (out / PROTOCOL).exists():  # it is written last: where it exists, this stage is done
        from brushloop.calibrate.recover import recover  # slow to import

        say(f"recover {folder}")
        chosen = settings.model_dump(include={"depth_range_mm", "tilt_range_deg", "presses", "seed"})
        show_work(recover, RecoverRequest(folder, out / RECOVERED, fit=fit, **chosen))
    check_recovered(out / RECOVERED)
    collection = CollectRequest(request.config, out / PROTOCOL, root, sheet=request.sheet, armed=request.armed)
    again = collected_session(replace(collection, on_screen=request.tui))

    from brushloop.calibrate.loop import compare  # slow to import

    command = f"brushloop repress compare {folder} {again} --fit {fit} --out {out}"
    say(f"$ {command}")
    return show_work(compare, CompareLoopRequest(folder, again, fit, out=out, command=command)).path


def check_recovered(path: Path) -> None:
    """Refuse presses recovered with a model that does not fit this brush."""
    rows = list(csv.DictReader(io.StringIO(read_text(path))))
    bound = sum("at_bound" in (row.get("flags") or "") for row in rows)
    if 2 * bound > len(rows):
        share = f"{bound} of {len(rows)} recovered presses lie at a limit of depth or tilt"
        raise ConfigError(path, "flags", f"{share}: the fit does not describe this brush, so nothing is pressed again")


class Settings(BaseModel):
    """What the presses of a loop depend on; kept in its folder, because a resumed loop must use the same settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    original: str
    """Session id."""
    original_sha256: str
    fit: BareName
    """Digest of the brush fit that recovers depth and tilt."""
    depth_range_mm: tuple[float, float]
    tilt_range_deg: tuple[float, float]
    presses: int | None = None
    """None: all."""
    seed: int


def begun_with(wanted: Settings, folder: Path) -> Settings:
    """The settings that the loop in that folder was begun with; a new one begins with those wanted, which are written.

    A loop goes on with its own fit, even if another one was made since. Raises `ConfigError` if anything else differs.
    """
    path = folder / SETTINGS
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, wanted.model_dump_json(indent=2) + "\n")
    try:
        begun = Settings.model_validate_json(read_bounded(path))
    except ValidationError:
        raise ConfigError(path, "", "holds no settings of `brushloop repress`: use another --out") from None
    for (name, was), (_, now) in zip(begun, wanted, strict=True):
        if was != now and name != "fit":
            raise ConfigError(path, name, f"this folder was begun with {was}, not {now}: use another --out")
    return begun
