"""pix2len over a session: measures the board at intervals, and detects whether camera or paper moved in between."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from brushloop.calibrate.board.lens import Gray, Lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.session import NO_BOARD, board_stills, sheet_of
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.board.view import see_board_and_lens
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.line import Line, fit_line
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, counted, unseen

MOVED_PX = 1.0
"""Movement of the board's middle between two views above which the camera or the board must have been touched."""
CHANGED = 5e-4
"""Relative change of pix2len that is worth a warning: 0.01 mm over a stroke of 20 mm."""


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
