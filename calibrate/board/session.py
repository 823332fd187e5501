"""The board, the lens and the photographs of the board that a session recorded."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from pydantic import BaseModel, ValidationError

from brushloop.calibrate.board.artefact import read_lens
from brushloop.calibrate.board.lens import Gray, Lens, LensUsed
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.board.view import see_board_and_lens
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.stats import Line, fit_line
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, counted, unseen

EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""
NO_BOARD = "holds no view of the board (a `board` step)"


SessionSource = Recording | Path
"""A recording, or the folder of a session that may still be open."""
M = TypeVar("M", bound=BaseModel)
MOVED_PX = 1.0
"""Movement of the board's middle between two views above which the camera or the board must have been touched."""
CHANGED = 5e-4
"""Relative change of pix2len that is worth a warning: 0.01 mm over a stroke of 20 mm."""


class _Paper(BaseModel):
    size_mm: tuple[float, float]


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
    for t_ns, still in recording.stills_of("board"):
        yield t_ns, decode_gray(still, str(recording.path))


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


@dataclass(frozen=True, slots=True)
class BoardAt:
    """The board at one moment."""

    t_ns: int
    plane: Plane
    mm_per_px: float
    """pix2len in the middle of the whole board, so that views of different corners give the scale of the same place."""
    moved_px: float
    """Distance of the board's middle from where it was first seen."""

    @property
    def reach(self) -> float:
        """Half of pix2len's 95 % interval, relative."""
        low, high = self.plane.interval_mm_per_px
        return (high - low) / 2.0 / self.plane.mm_per_px


@dataclass(frozen=True, slots=True)
class Drift:
    """The board through a session."""

    seen: tuple[BoardAt, ...]
    unseen: tuple[tuple[int, str], ...]
    """(t_ns, why) of stills of the board that cannot be used."""
    trend: Line | None
    """Relative change of pix2len per hour; None with fewer than three views."""
    warnings: tuple[str, ...]


def board_over_session(
    recording: Recording, spec: BoardSpec, lens: Lens | None = None, progress: Progress = unseen
) -> Drift:
    """Measure the board in every still of a `board` step. Raises `CalibrationError` where there is none."""
    stills = list(board_stills(recording))
    if not stills:
        raise CalibrationError(str(recording.path), NO_BOARD)
    looked_at = counted(stills, "photographs of the board measured", len(stills), progress)
    return drift(looked_at, spec, lens, sheet_of(recording))


def drift(
    stills: Iterable[tuple[int, Gray]],
    spec: BoardSpec,
    lens: Lens | None = None,
    sheet_mm: tuple[float, float] | None = None,
) -> Drift:
    """pix2len of each (t_ns, gray photograph) in order. Photographs without a board are listed, not raised.

    Raises `CalibrationError` if the board is seen in none.
    """
    seen: list[BoardAt] = []
    missing: list[tuple[int, str]] = []
    for t_ns, image in stills:
        try:
            plane = see_board_and_lens(image, spec, lens, f"the board at {t_ns} ns", sheet_mm)
        except CalibrationError as error:
            missing.append((t_ns, error.what))
            continue
        middle = np.array([spec.squares]) * spec.square_mm / 2.0 + np.array([spec.origin_mm])
        first = seen[0].plane if seen else plane
        here, then = plane.to_image(middle)[0], first.to_image(middle)[0]
        seen.append(BoardAt(t_ns, plane, plane.scale_at(here), float(np.linalg.norm(here - then))))
    if not seen:
        problem = (
            f"is not seen in any of {len(missing)} photographs: {missing[0][1]}"
            if missing
            else "was never photographed"
        )
        raise CalibrationError("the board", problem)
    return Drift(tuple(seen), tuple(missing), _trend(seen), _warnings(seen, missing))


def _trend(seen: Sequence[BoardAt]) -> Line | None:
    if len(seen) < 3:
        return None
    first = seen[0]
    hours = [(s.t_ns - first.t_ns) / 3.6e12 for s in seen]
    return fit_line(hours, [s.mm_per_px / first.mm_per_px - 1.0 for s in seen])


def _warnings(seen: Sequence[BoardAt], missing: Sequence[tuple[int, str]]) -> tuple[str, ...]:
    warnings = [f"the board is not seen at {t_ns} ns: {why}" for t_ns, why in missing]
    warnings += [f"at {s.t_ns} ns: {flag}" for s in seen for flag in s.plane.flags]
    first = seen[0]
    for s in seen[1:]:
        change = s.mm_per_px / first.mm_per_px - 1.0
        if abs(change) > max(CHANGED, float(np.hypot(first.reach, s.reach))):
            warnings.append(
                f"pix2len changed by {100 * change:+.3f} % until {s.t_ns} ns: calibrate the parts separately"
            )
        if s.moved_px > MOVED_PX:
            warnings.append(f"the board moved by {s.moved_px:.1f} px until {s.t_ns} ns: camera or board was touched")
    return tuple(warnings)
