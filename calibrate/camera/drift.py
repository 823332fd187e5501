"""pix2len over a session: the board seen again at intervals, and whether the camera or the paper moved in between."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrate.calibration import EFFECTIVE
from calibrate.camera.boards import see
from calibrate.camera.lens import Gray, Lens, unknown_lens
from calibrate.camera.plane import Plane, fit_bent_plane
from calibrate.errors import CalibrationError
from calibrate.measure import Line, fit_line
from calibrate.scale import BoardSpec
from sessions import container
from sessions.errors import SessionDamaged
from sessions.messages import decode_gray, decode_still
from sessions.reader import Recording
from sessions.schemas import StepEvent, Topic

MOVED_PX = 1.0
"""The board's middle moved by more between two views: someone touched the camera, or the board."""
CHANGED = 5e-4
"""Relative change of pix2len that is worth a warning: 0.01 mm over a stroke of 20 mm."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The board at one moment."""

    t_ns: int
    plane: Plane
    moved_px: float
    """How far the board's middle lies from where it was first seen."""


@dataclass(frozen=True, slots=True)
class Drift:
    """The board through a session."""

    seen: tuple[Seen, ...]
    unseen: tuple[tuple[int, str], ...]
    """(t_ns, why) of stills of the board that cannot be used."""
    trend: Line | None
    """Relative change of pix2len per hour; None with fewer than three views."""
    warnings: tuple[str, ...]


def board_over_session(session: Path, spec: BoardSpec, lens: Lens | None = None) -> Drift:
    """Every still taken in a `board` step. Raises `CalibrationError` where there is none."""
    recording = Recording(session)
    stills: list[tuple[int, Gray]] = []
    kind = ""
    for _schema, channel, message in container.messages(recording.path, [str(Topic.STEP), str(Topic.STILL)]):
        if channel.topic == Topic.STEP:
            event = StepEvent.model_validate_json(message.data)
            kind = event.kind if event.phase == "begin" else ""
        elif kind == "board":
            image = decode_gray(decode_still(message.data), str(recording.path))
            stills.append((message.log_time, image))
    if not stills:
        raise CalibrationError(str(recording.path), "holds no view of the board (a `board` step)")
    return drift(stills, spec, lens)


def board_of(session: Path) -> BoardSpec:
    """The board of a session's rig. Raises `CalibrationError` where the recording names none."""
    recording = Recording(session)
    where = f"{recording.path} {EFFECTIVE}"
    try:
        return BoardSpec.model_validate(json.loads(recording.attachment(EFFECTIVE))["board"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(where, "holds no board") from None


def drift(stills: Sequence[tuple[int, Gray]], spec: BoardSpec, lens: Lens | None = None) -> Drift:
    """pix2len of each (t_ns, gray photograph) in order. Photographs without a board are listed, not raised."""
    seen: list[Seen] = []
    unseen: list[tuple[int, str]] = []
    for t_ns, image in stills:
        try:
            plane = see_plane(image, spec, lens, f"the board at {t_ns} ns")
        except (CalibrationError, SessionDamaged) as error:
            unseen.append((t_ns, error.what))
            continue
        middle = np.array([spec.squares]) * spec.square_mm / 2.0 + np.array([spec.origin_mm])
        first = seen[0].plane if seen else plane
        moved = float(np.linalg.norm(plane.to_image(middle) - first.to_image(middle)))
        seen.append(Seen(t_ns, plane, moved))
    return Drift(tuple(seen), tuple(unseen), _trend(seen), _warnings(seen, unseen))


def see_plane(image: Gray, spec: BoardSpec, lens: Lens | None = None, where: str = "camera") -> Plane:
    """The paper plane from one photograph, its own radial term fitted. Raises `CalibrationError`."""
    view = see(image, spec, where)
    if lens is not None and lens.size_px != view.size_px:
        raise CalibrationError(where, f"is {view.size_px} px, the lens was calibrated at {lens.size_px} px")
    height_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    flip = np.array([1.0, -1.0])
    paper_mm = np.array([spec.origin_mm[0], spec.origin_mm[1] + height_mm]) + flip * view.board_mm
    return fit_bent_plane(view.pixels, paper_mm, lens or unknown_lens(view.size_px), where)


def _trend(seen: Sequence[Seen]) -> Line | None:
    if len(seen) < 3:
        return None
    first = seen[0]
    hours = [(s.t_ns - first.t_ns) / 3.6e12 for s in seen]
    return fit_line(hours, [s.plane.mm_per_px / first.plane.mm_per_px - 1.0 for s in seen])


def _warnings(seen: Sequence[Seen], unseen: Sequence[tuple[int, str]]) -> tuple[str, ...]:
    told = [f"the board is not seen at {t_ns} ns: {why}" for t_ns, why in unseen]
    if not seen:
        return tuple(told)
    first = seen[0].plane
    reach = (first.interval_mm_per_px[1] - first.interval_mm_per_px[0]) / 2.0
    for s in seen[1:]:
        change = s.plane.mm_per_px / first.mm_per_px - 1.0
        own = (s.plane.interval_mm_per_px[1] - s.plane.interval_mm_per_px[0]) / 2.0
        if abs(change) > max(CHANGED, float(np.hypot(reach, own)) / first.mm_per_px):
            told.append(f"pix2len changed by {100 * change:+.3f} % until {s.t_ns} ns: calibrate the parts on their own")
        if s.moved_px > MOVED_PX:
            told.append(f"the board moved by {s.moved_px:.1f} px until {s.t_ns} ns: camera or board was touched")
    return tuple(told)
