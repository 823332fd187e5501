"""The board in one photograph, for live use, artefacts and pre-flight, and through a recorded session.

Corners are found, the plane is fitted, and the lens is checked.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydantic import BaseModel, ValidationError

from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.intrinsics import RMS_LIMIT_PX, LensFile, read_lens
from brushloop.calibrate.board.lens import Floats, Gray, Lens, unknown_lens
from brushloop.calibrate.board.pix2len import Plane, distorted_share, fit_plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.stats import Line, fit_line
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, counted, unseen

VISIBLE_PX = 0.5
"""A lens that distorts the board by more (root mean square) needs a lens file: one flat view cannot calibrate it."""
REMAINING_PX = 1.5
"""Distortion left by the lens file: more means another camera; less is a small change of focus, which k1 describes."""
DISTORTED_SHARE = 0.85
"""Share of squared residuals that one radial term explains: 0.7 for a board curled lengthwise, more for a lens."""
NO_LENS_FILE = (
    "the lens bends straight lines: calibrate it with `brushloop camera intrinsics`, then name the lens file as "
    "camera.lens_file in rig.toml, or with --lens"
)
OTHER_LENS = "distortion remains after the lens was corrected: the lens file is of another camera, or of another focus"
LEAST_PX_PER_MM = 4.0
"""Below this a tip of 0.5 mm is two pixels wide."""
WORST_INTERVAL = 5e-4
"""Relative half width of pix2len's interval: 0.01 mm over 20 mm."""
REFOCUSED = 0.02
"""Difference of k1 from its calibrated value beyond which the lens has changed."""
EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""
NO_BOARD = "holds no view of the board (a `board` step)"


SessionSource = Recording | Path
"""A recording, or the folder of a session that may still be open."""
MOVED_PX = 1.0
"""Movement of the board's middle between two views above which the camera or the board must have been touched."""
CHANGED = 5e-4
"""Relative change of pix2len that is worth a warning: 0.01 mm over a stroke of 20 mm."""


def see_board(image: Gray, spec: BoardSpec, where: str = "camera", lens: Lens | None = None) -> Plane:
    """Fit the paper plane in an undistorted photograph, or in one seen through a known lens, which is not refitted.

    Raises `CalibrationError`; if the lens distorts, the message says what to do about it.
    """
    view, through = _find(image, spec, where, lens)
    corners_mm = paper_mm(view, spec)
    try:
        return replace(fit_plane(view.pixels, corners_mm, through, where, radial_terms=0), flags=view.flags)
    except CalibrationError as error:
        if distorted_share(view.pixels, corners_mm, through, where) > DISTORTED_SHARE:
            raise CalibrationError(where, f"{error.what}; {NO_LENS_FILE if lens is None else OTHER_LENS}") from None
        raise


def see_board_and_lens(
    image: Gray,
    spec: BoardSpec,
    lens: Lens | None = None,
    where: str = "camera",
    sheet_mm: tuple[float, float] | None = None,
) -> Plane:
    """Fit the paper plane and the lens's k1 in a photograph as it was taken.

    A sheet of `sheet_mm` may lie on the board. Raises `CalibrationError`.
    """
    view, through = _find(image, spec, where, lens, sheet_mm)
    return replace(fit_plane(view.pixels, paper_mm(view, spec), through, where), flags=view.flags)


def calibration_plane(
    image: Gray, spec: BoardSpec, lens: Lens | None, where: str, sheet_mm: tuple[float, float] | None = None
) -> Plane:
    """`see_board_and_lens` for measuring: also raises `CalibrationError` if the lens distorts more than is known."""
    plane = see_board_and_lens(image, spec, lens, where, sheet_mm)
    if problem := lens_problem(plane, known=lens is not None):
        raise CalibrationError(where, problem)
    return plane


def lens_problem(plane: Plane, *, known: bool) -> str:
    """Advice about the lens; empty if it distorts little, or as its file says."""
    if plane.distortion_px <= (REMAINING_PX if known else VISIBLE_PX):
        return ""
    advice = OTHER_LENS if known else NO_LENS_FILE
    return f"the board is bent by {plane.distortion_px:.1f} px: if it lies flat, {advice}"


def preflight(
    image: Gray, spec: BoardSpec, lens: LensFile | None = None, rms_limit_px: float = RMS_LIMIT_PX
) -> tuple[Plane, tuple[str, ...]]:
    """The plane in a photograph of the board, and warnings for the operator before a session.

    Raises `CalibrationError` where the board is not seen at all.
    """
    plane = see_board_and_lens(image, spec, lens.lens if lens else None)
    warnings = list(plane.flags)
    if lens is not None and lens.rms_px > rms_limit_px:
        warnings.append(f"the lens was calibrated with a residual of {lens.rms_px:.2f} px, limit {rms_limit_px:g} px")
    if problem := lens_problem(plane, known=lens is not None):
        warnings.append(problem)
    if plane.rms_px > rms_limit_px:
        warnings.append(f"the board's residual is {plane.rms_px:.2f} px, limit {rms_limit_px:g} px: is the board flat?")
    k1 = plane.lens.distortion[0]
    if lens is not None and abs(k1 - lens.lens.distortion[0]) > REFOCUSED:
        warnings.append(f"k1 is {k1:+.3f} here and was {lens.lens.distortion[0]:+.3f}: was the lens refocused?")
    if 1.0 / plane.mm_per_px < LEAST_PX_PER_MM:
        warnings.append(f"only {1.0 / plane.mm_per_px:.1f} px/mm, at least {LEAST_PX_PER_MM:g} are needed")
    low, high = plane.interval_mm_per_px
    if (high - low) / 2.0 > WORST_INTERVAL * plane.mm_per_px:
        reach = 50.0 * (high - low) / plane.mm_per_px
        warnings.append(f"pix2len is only known to {reach:.2f} %: show more of the board")
    if plane.dropped:
        warnings.append(f"{len(plane.dropped)} corners do not lie on the plane of the others")
    return plane, tuple(warnings)


def paper_mm(view: BoardView, spec: BoardSpec) -> Floats:
    """(n, 2) corners of a view in the paper frame."""
    depth_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    flip = np.array([1.0, -1.0])
    return np.array([spec.origin_mm[0], spec.origin_mm[1] + depth_mm]) + flip * view.board_mm


def corners_beside(spec: BoardSpec, sheet_mm: tuple[float, float]) -> int:
    """Number of corners at least half a square outside a sheet that lies at the origin of the paper frame."""
    (columns, rows), side, (x_mm, y_mm) = spec.squares, spec.square_mm, spec.origin_mm
    across = x_mm + side * np.arange(1, columns)
    along = y_mm + side * np.arange(1, rows)
    gap_mm = 0.5 * side
    clear_x = (across <= -gap_mm) | (across >= sheet_mm[0] + gap_mm)
    clear_y = (along <= -gap_mm) | (along >= sheet_mm[1] + gap_mm)
    return int((clear_x[:, None] | clear_y[None, :]).sum())


def _find(
    image: Gray, spec: BoardSpec, where: str, lens: Lens | None, sheet_mm: tuple[float, float] | None = None
) -> tuple[BoardView, Lens]:
    if lens is not None:
        lens.check_size(image, where)
    view = find_board(image, spec, where, None if sheet_mm is None else corners_beside(spec, sheet_mm))
    return view, lens or unknown_lens(view.size_px)


class _Paper(BaseModel):
    size_mm: tuple[float, float] | None = None


class _Camera(BaseModel):
    optics: Lens | None = None
    lens_file: str | None = None


class RigView(BaseModel):
    """What a rig's configuration says of the board, the sheet that lies on it, and the lens; None if nothing."""

    board: BoardSpec | None = None
    paper: _Paper | None = None
    camera: _Camera | None = None

    @property
    def sheet_mm(self) -> tuple[float, float] | None:
        """Width and height of the sheet."""
        return None if self.paper is None else self.paper.size_mm

    @property
    def lens(self) -> Lens | None:
        """The lens that a session was collected with."""
        return None if self.camera is None else self.camera.optics


def rig_of(session: SessionSource) -> RigView:
    """The rig that a session was collected with. Raises `CalibrationError`."""
    inside = isinstance(session, Recording)
    where = f"{session.path} {EFFECTIVE}" if inside else str(session / EFFECTIVE)
    data = session.attachment(EFFECTIVE) if inside else read_bounded(session / EFFECTIVE)
    try:
        tables: object = json.loads(data)
    except (ValueError, RecursionError):
        tables = None
    if not isinstance(tables, dict):
        raise CalibrationError(where, "holds no board")
    return rig_view(cast("dict[str, Any]", tables), where)


def rig_view(tables: dict[str, Any], where: str) -> RigView:
    """The view of a configuration's tables. Raises `CalibrationError` that names the file and the field."""
    try:
        return RigView.model_validate(tables)
    except ValidationError as error:
        raise invalid(where, error) from None


def board_of(session: SessionSource) -> BoardSpec:
    """The board of a session's rig. Raises `CalibrationError` where the session names none."""
    board = rig_of(session).board
    if board is None:
        where = session.path if isinstance(session, Recording) else session
        raise CalibrationError(f"{where} {EFFECTIVE}", "holds no board")
    return board


def known_lens(recording: Recording, given: Path | None) -> Lens | None:
    """The lens file that was given, else the session's own. Raises `CalibrationError`."""
    return read_lens(given) if given is not None else rig_of(recording).lens


def board_stills(recording: Recording) -> Iterator[tuple[int, Gray]]:
    """(t_ns, gray photograph) of every `board` step in order. Raises `SessionDamaged` for one that cannot be read."""
    for t_ns, still in recording.stills_of("board"):
        yield t_ns, decode_gray(still, str(recording.path))


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
    return drift(looked_at, spec, lens, rig_of(recording).sheet_mm)


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
