"""What the review shows of a session: its captures, their pictures, and how alike the presses of a condition are."""

from __future__ import annotations

import itertools
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.board.pix2len import Plane, see_board
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.calibrate.fit.brush import BrushFit
from brushloop.calibrate.session import board_of, lens_in_use
from brushloop.calibrate.stats import odd_waits, waits_of
from brushloop.collect.engine.last_capture import likeness, mark_of, pictures_of
from brushloop.collect.rig.paper import Patch
from brushloop.collect.tui.capture_screen import LargeCapture
from brushloop.model.similarity import csim
from brushloop.sessions.disk import check_folder
from brushloop.sessions.errors import InputError, SessionDamaged
from brushloop.sessions.events import CaptureResult, Press, Remark
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import merged_file, remarks_of
from brushloop.sessions.records import Check, Condition, Quality, Stroke, Topic

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brushloop.calibrate.board.lens import Lens

NO_FIT = "no fit yet: run `brushloop fit`"


@dataclass(frozen=True, slots=True)
class ReviewCapture:
    """One capture of a session."""

    result: CaptureResult
    file: str
    remark: Remark | None
    unlike: str = ""
    """How its time from dip to touch differs from that of the session's other strokes; empty if it does not differ."""

    @property
    def press(self) -> Press:
        """The press in it."""
        return self.result.press

    @property
    def counts(self) -> bool:
        """Whether it counts: kept by the run, and not marked bad afterwards."""
        return self.result.kept and not (self.remark is not None and self.remark.bad)


@dataclass(frozen=True, slots=True)
class CapturePictures:
    """The pictures of one capture, and where it is in the recording."""

    photo: NDArray[np.uint8]
    """(h, w) gray: the field around its zero-touch point, or the whole photograph where the board is not seen."""
    binary: NDArray[np.bool_] | None
    log_ns: int
    """When the still arrived at the host: the time to jump to in a viewer."""
    checks: tuple[Check, ...] = ()
    """Checks of its quality as the run recorded them."""


class Review:
    """One session's folder, open or closed; reads it and writes nothing."""

    not_compared: str = ""
    """Why photographs are shown whole and presses are not compared; empty where board and lens are known."""

    def __init__(self, folder: Path) -> None:
        """Raises `SessionDamaged`, and `InputError` if the session was not collected here or holds links."""
        self.folder = folder
        if not (folder / JOURNAL_NAME).is_file():
            raise InputError(folder, f"holds no {JOURNAL_NAME}: imported photographs are compared with `validate`")
        check_folder(folder)
        self._plane: Plane | None = None
        self._pictures: dict[int, CapturePictures] = {}
        self._board: BoardSpec | None = None
        self._lens: Lens | None = None
        try:
            # As the session recorded them: lens files lie beside the rig's own rig.toml, not beside its snapshot here.
            self._lens = lens_in_use(folder)
            self._board = board_of(folder)
        except CalibrationError as error:
            self.not_compared = str(error)
        self.read()

    def read(self) -> None:
        """Read the journal and the remarks again."""
        state, remarks = replay(self.folder / JOURNAL_NAME), remarks_of(self.folder)
        self.open = state.is_open
        odd = odd_waits(waits_of(state))
        self.captures = tuple(
            ReviewCapture(result, step.file, remarks.get(result.still), odd.get(result.still, ""))
            for step in state.files.values()
            if isinstance(result := step.result, CaptureResult)
        )

    def pictures(self, capture: ReviewCapture) -> CapturePictures:
        """The pictures of one capture, made once. Takes a tenth of a second: call it off a screen's loop.

        Raises `SessionDamaged` if the still is missing.
        """
        still = capture.result.still
        if still not in self._pictures:
            self._pictures[still] = self._make_pictures(capture)
        return self._pictures[still]

    def repeatability(self, condition: Condition) -> tuple[float, int] | None:
        """(mean CSIM of every pair, captures) of the counted presses of one condition; None for fewer than two.

        CSIM is that of the validation, on the binarised 128 x 128 images in the millimetre alignment.
        """
        binaries = [
            pictures.binary.astype("float32")
            for capture in self.captures
            if capture.press.condition == condition and capture.counts
            if (pictures := self.pictures(capture)).binary is not None
        ]
        if len(binaries) < 2:
            return None
        return statistics.fmean(csim(a, b) for a, b in itertools.combinations(binaries, 2)), len(binaries)

    def large(self, capture: ReviewCapture) -> LargeCapture:
        """One capture with the prediction of the session's fitted brush, where it has one.

        Call it off a screen's loop. Raises `SessionDamaged` as `pictures` does.
        """
        pictures, predicted, model = self.pictures(capture), None, NO_FIT
        try:
            if (found := current(self.folder, FITS)) is not None:
                fit = load_artefact(found, BrushFit)
                predicted = mark_of(fit.press(), capture.press.condition)
                model = f"CCD-BSM fitted to {fit.strokes} strokes of {fit.session_id}"
        except CalibrationError as error:
            model = str(error)
        alike = likeness(pictures.binary, predicted)
        return LargeCapture(capture.press, pictures.photo, pictures.binary, predicted, model, alike, pictures.checks)

    def _make_pictures(self, capture: ReviewCapture) -> CapturePictures:
        path = self.folder / capture.file
        path = path if path.is_file() else merged_file(self.folder)
        image, log_ns, stroke = None, 0, None
        checks: tuple[Check, ...] = ()
        for _schema, channel, message in McapFile(path).sound().messages([Topic.STILL, Topic.STROKE, Topic.QUALITY]):
            if message.sequence != capture.result.still:
                continue
            if channel.topic == Topic.STILL:
                image, log_ns = decode_gray(decode_still(message.data, path), str(path)), message.log_time
            elif channel.topic == Topic.QUALITY:
                checks = Quality.model_validate_json(message.data).checks
            else:
                stroke = Stroke.model_validate_json(message.data)
        if image is None:
            raise SessionDamaged(path, f"holds no still {capture.result.still}")
        whole = CapturePictures(image, None, log_ns, checks)
        if stroke is None or stroke.cell_mm is None or self._board is None:
            return whole  # a take that does not count has no stroke record
        if self._lens is not None:
            if image.shape[::-1] != self._lens.size_px:
                return whole  # the lens was calibrated for another size
            image = self._lens.undistort(image)
        try:
            self._plane = see_board(image, self._board)
        except CalibrationError:
            if self._plane is None:
                return whole
        return CapturePictures(*pictures_of(image, self._plane, Patch(0, *stroke.cell_mm)), log_ns, checks)
