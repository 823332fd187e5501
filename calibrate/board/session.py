"""The board, the lens and the photographs of the board that a session recorded."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, ValidationError

from brushloop.calibrate.board.artefact import read_lens
from brushloop.calibrate.board.lens import Gray, LensUsed
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import StepEvent, Topic

EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""
NO_BOARD = "holds no view of the board (a `board` step)"


SessionSource = Recording | Path
"""A recording, or the folder of a session that may still be open."""


class _Paper(BaseModel):
    size_mm: tuple[float, float]


M = TypeVar("M", bound=BaseModel)


def board_of(session: SessionSource) -> BoardSpec:
    """The board of a session's rig. Raises `CalibrationError` where the session names none."""
    try:
        board = _rig(session)["board"]
    except KeyError:
        raise CalibrationError(_where(session), "holds no board") from None
    return _parsed(session, "board", BoardSpec, board)


def sheet_of(recording: Recording) -> tuple[float, float] | None:
    """Width and height in mm of the sheet that lies on the board; None where the rig's configuration has none."""
    paper = _rig(recording).get("paper")
    size = cast("dict[str, Any]", paper).get("size_mm") if isinstance(paper, dict) else None
    return None if size is None else _parsed(recording, "paper", _Paper, {"size_mm": size}).size_mm


def lens_of_session(session: SessionSource) -> LensUsed | None:
    """The lens that the session was collected with; None where its rig named none. Raises `CalibrationError`."""
    camera = _rig(session).get("camera")
    optics = cast("dict[str, Any]", camera).get("optics") if isinstance(camera, dict) else None
    return None if optics is None else _parsed(session, "camera.optics", LensUsed, optics)


def known_lens(recording: Recording, given: Path | None) -> LensUsed | None:
    """The lens file that was given, else the session's own. Raises `CalibrationError`."""
    return read_lens(given) if given is not None else lens_of_session(recording)


def board_stills(recording: Recording) -> Iterator[tuple[int, Gray]]:
    """(t_ns, gray photograph) of every `board` step in order. Raises `SessionDamaged` for one that cannot be read."""
    kind = ""
    for _schema, channel, message in recording.messages(Topic.STEP, Topic.STILL):
        if channel.topic == Topic.STEP:
            event = StepEvent.model_validate_json(message.data)
            kind = event.kind if event.phase == "begin" else ""
        elif kind == "board":
            yield message.log_time, decode_gray(decode_still(message.data, recording.path), str(recording.path))


def _rig(session: SessionSource) -> dict[str, Any]:
    data = read_bounded(session / EFFECTIVE) if isinstance(session, Path) else session.attachment(EFFECTIVE)
    try:
        rig: Any = json.loads(data)
    except (ValueError, RecursionError):
        rig = None
    if not isinstance(rig, dict):
        raise CalibrationError(_where(session), "holds no board")
    return cast("dict[str, Any]", rig)


def _parsed(session: SessionSource, name: str, kind: type[M], values: object) -> M:
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join([name, *map(str, first["loc"])])
        raise CalibrationError(_where(session), f"{field}: {first['msg']}") from None


def _where(session: SessionSource) -> str:
    return str(session / EFFECTIVE) if isinstance(session, Path) else f"{session.path} {EFFECTIVE}"
