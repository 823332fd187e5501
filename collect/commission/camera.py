"""Step 2: the camera, the print of the board, and the lens by photographs of the board held in hand."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path

import cv2
import numpy as np

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import GOOD_VIEWS, RMS_LIMIT_PX, fit_lens, guidance, held, nominal_normals
from brushloop.calibrate.board.spec import BoardSpec, BoardView, describe
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_gray
from brushloop.collect.commission.visit import NO, YES, Notebook, Step, Taught, Visit, choice_of, number_of
from brushloop.collect.errors import NotAccepted
from brushloop.collect.operator import Prompt
from brushloop.collect.photograph.frames import Gray, each_frame
from brushloop.collect.rig.devices import identified
from brushloop.drivers.camera import OpenCvCamera
from brushloop.drivers.camera.source import PROPERTIES, CameraTable, Locked
from brushloop.drivers.devices import Frame, Stamp
from brushloop.drivers.host import Clock

LATE_MS = 2500.0
"""Until the delay is measured, a picture counts as taken this long before it came: no useful camera is slower."""
SETTLE_S = 2.0
"""How long a device may take to choose its settings."""
VIEW = "aside.lens_view_"
"""Beginning of the fields for the photographs of the held board: the names of their files."""
MOST_VIEWS = 20
HOLD = (
    "flat, in the middle of the picture",
    "slanted to the left",
    "slanted to the right",
    "slanted away from the camera",
    "slanted toward the camera",
    "in the upper left of the picture",
    "in the upper right of the picture",
    "in the lower right of the picture",
    "in the lower left of the picture",
    "turned by a quarter and slanted",
)
MIRRORED = "Switch mirroring (`flip`) off in the camera's set-up, or take the mirror out of its way; then try again."
OTHER_PRINT = (
    "Count the squares of the print again, the outermost ones too, and measure one; then repeat the camera step."
)


def _squares(line: str) -> list[float]:
    """Both numbers of squares from `26x20`. Raises ValueError, worded for the person who typed it."""
    across, _, along = line.lower().partition("x")
    if not (across.strip().isdecimal() and along.strip().isdecimal()):
        raise ValueError(f"{line!r} is not two numbers of squares like 26x20")
    return [int(across), int(along)]


ASK_SQUARES = Prompt(
    "Squares of the print of `brushloop camera board`, along its longer and its shorter side, as 26x20", read=_squares
)
SQUARE = number_of("Side of a square: measure ten with calipers and divide by ten", 2.0, 100.0, "mm")
MARKER_SHARE = 0.75
"""Side of a marker as a share of its square's, as `brushloop camera board` prints them."""
PRINTED = ("board.squares", "board.square_mm", "board.marker_mm", "board.dictionary")


class CameraStep(Step):
    """Source, settings, frame rate, print of the board, lens."""

    name = "camera"
    title = "Find the camera"
    minutes = 12
    observes = ("camera.", *PRINTED, VIEW)

    async def carry_out(self, visit: Visit) -> None:
        """Ask for source and print, measure the rest. Raises `NotAccepted`, `DeviceError`, `CalibrationError`."""
        await visit.value("board.squares", ASK_SQUARES)
        square_mm = await visit.value("board.square_mm", SQUARE)
        marker = number_of("Side of a marker", 1.0, 100.0, "mm", f"{MARKER_SHARE * square_mm:g}")
        await visit.value("board.marker_mm", marker)
        family = Prompt("Family of the board's markers (an ArUco dictionary)", default="DICT_5X5_1000", read=str)
        await visit.value("board.dictionary", family)
        with visit.asked_again_if_refused(*PRINTED):
            try:
                board_of(visit.notebook)
            except ValueError as error:
                raise NotAccepted(f"no such board: {error}".splitlines()[0] + ".", "Read the print again.") from None
        if "camera.source" not in visit.notebook.values:
            await self._source(visit)
        async with opened(visit) as camera:
            visit.working("looking for the board")
            await _board_in(visit, await still(camera, visit.clock), "camera", lying=True)
            await self._lens(visit, camera)

    async def _source(self, visit: Visit) -> None:
        """Ask for a camera and show its picture, until the person says that it is the one over the sheet."""
        devices = video_devices(Path("/dev"))
        number = f", or the number of a video device: {', '.join(devices.values())}" if devices else ""
        address = Prompt(f"Address of the camera's stream, as http://192.0.2.8/stream.mjpg{number}", read=str)
        source = over_sheet = ""
        while over_sheet != YES.key:
            source = str(await visit.ask(address))
            visit.working(f"waiting for a picture of {source}")
            async with opened(visit, source) as camera:
                picture = await still(camera, visit.clock)
            label, (height, width) = devices.get(source, source), picture.shape
            visit.say(f"{label}: {width} x {height} px", picture=picture)
            probably = NO if await _board_in(visit, picture, source, lying=False) is None else YES
            question = f"Is {label} the camera over the sheet? Look at its picture."
            over_sheet = await visit.ask(choice_of(question, (YES, NO), probably.key))
        # What a device chose by itself; the settings of a stream only its own set-up can change.
        locked = await asyncio.to_thread(found_settings, int(source), SETTLE_S) if source.isdecimal() else {}
        if not locked:
            visit.say(
                "The settings of a stream cannot be set from here: switch automatic exposure, white balance and focus "
                "off in the camera's own set-up.",
                tone="warning",
            )
        values = {
            f"camera.locked.{name}": Taught(
                int(value) if name in ("width", "height") else value, "chosen by the camera, then locked and read back"
            )
            for name, value in locked.items()
        }
        values["camera.kind"] = Taught("opencv", "the only kind that exists")
        values["camera.source"] = Taught(source, "typed, and confirmed by its picture")
        visit.keep(values)

    async def _lens(self, visit: Visit, camera: OpenCvCamera) -> None:
        """Fit the lens to photographs of the held board; nothing where the person skips the first ones."""
        spec, folder = board_of(visit.notebook), visit.rig_path.with_name(f"{visit.rig_path.stem}.lens")
        folder.mkdir(exist_ok=True)
        taken = [folder / str(name) for name in visit.notebook.table(VIEW).values()]
        views = [
            await asyncio.to_thread(find_board, read_gray(path), spec, path.name, 0) for path in taken if path.is_file()
        ]
        for index in range(MOST_VIEWS):
            if f"{VIEW}{index:02d}" in visit.notebook.values:
                continue
            if len(views) >= GOOD_VIEWS and not still_missing(views):
                break
            if not await self._held(visit, camera, folder, index, views) and not views:
                visit.say("Without a lens file, straight lines must look straight in the picture.", tone="warning")
                return
            if views and (todo := still_missing(views)):
                visit.say(*todo)
        visit.working("computing the lens")
        digests = {view.name: hashlib.sha256((folder / view.name).read_bytes()).hexdigest() for view in views}
        file = await asyncio.to_thread(fit_lens, views, describe(spec), digests, {})
        for warning in (*file.warnings, *file.guidance):
            visit.say(warning, tone="warning")
        path = file.save(visit.rig_path.parent)
        how = f"fitted to {len(file.residuals_px)} photographs of the board at {file.ways} angles"
        known = f"residual {file.rms_px:.2f} px (limit: {RMS_LIMIT_PX:g} px)"
        visit.keep({"camera.lens_file": Taught(str(path.relative_to(visit.rig_path.parent)), how, known=known)})
        visit.say(f"Lens: {known} over {len(file.residuals_px)} photographs.")

    async def _held(self, visit: Visit, camera: OpenCvCamera, folder: Path, index: int, views: list[BoardView]) -> bool:
        """Take one photograph of the held board, so that a resumed session does not; False if the person skips it."""
        where = HOLD[index] if index < len(HOLD) else "in a new place"
        how = f"View {index + 1}: cover the board on the table. Hold the second print {where}, sharp and still."
        why = "The lens is computed from these views."
        async with shown_live(visit, camera):
            if not await visit.brought(f"hold-board {index}", f"{how} {why}", may_skip=True):
                return False
        visit.working("looking for the board in the picture")
        picture = await still(camera, visit.clock)
        coded = cv2.imencode(".png", picture)[1].tobytes()
        # Named after its content too: a photograph taken once more does not replace one that going back restores.
        name = f"view-{index + 1:02d}-{hashlib.sha256(coded).hexdigest()[:16]}.png"
        if (view := await _board_in(visit, picture, name, lying=False)) is None:
            return True
        (folder / name).write_bytes(coded)
        visit.keep({f"{VIEW}{index:02d}": Taught(name, "photograph of the board held in hand")})
        views.append(view)
        return True


async def _board_in(visit: Visit, picture: Gray, name: str, *, lying: bool) -> BoardView | None:
    """The board in a picture, and how much of it is seen; None, with a warning, where it is not.

    Raises `NotAccepted` where the camera is mirrored or, by a board that is `lying` flat, the print is another one than
    was described. A board in the hand may only look so.
    """
    board = board_of(visit.notebook)
    try:
        view = await asyncio.to_thread(find_board, picture, board, name, 0)  # any number of corners will do
    except CalibrationError as error:
        if "mirrored" in error.what:
            raise NotAccepted(f"{error.what}.", MIRRORED) from None
        if lying and ("another board" in error.what or "arranged" in error.what):
            visit.forget(*PRINTED)
            raise NotAccepted(f"{error.what}.", OTHER_PRINT) from None
        visit.say(f"The board is not seen: the picture {error.what}", picture=picture, tone="warning")
        return None
    columns, rows = board.squares
    if not lying:
        visit.say(f"{len(view.pixels)} of {(columns - 1) * (rows - 1)} corners of the board are seen", picture=picture)
    return view


def video_devices(folder: Path) -> dict[str, str]:
    """Each video device in `/dev`: its number, and that with the link which tells two alike apart, by serial number or
    else by socket."""
    links = {link.resolve().name: link.name for by in ("path", "id") for link in sorted(folder.glob(f"v4l/by-{by}/*"))}
    numbers = sorted((path.name[5:] for path in folder.glob("video*") if path.name[5:].isdecimal()), key=int)
    return {number: f"{number} ({links.get(f'video{number}', 'unnamed')})" for number in numbers}


def still_missing(views: Sequence[BoardView]) -> tuple[str, ...]:
    """Instructions for further photographs; empty where the views suffice. At least one view."""
    normals = nominal_normals(views)
    slants_deg = np.degrees(np.arccos(np.clip(normals[:, 2], -1.0, 1.0))).tolist()
    return guidance(views, slants_deg, int(held(normals).max()) + 1)


def board_of(notebook: Notebook) -> BoardSpec:
    """The print as it was described, its lower left corner at the origin. Raises ValueError where there is none."""
    return BoardSpec.model_validate(notebook.table("board.") | {"origin_mm": (0.0, 0.0)})


@contextlib.asynccontextmanager
async def opened(visit: Visit, source: str | None = None) -> AsyncGenerator[OpenCvCamera]:
    """A connected camera, the taught one unless another is named; its settings are locked as far as they were taught.

    Raises `DeviceError`, also for a setting that the camera does not keep.
    """
    locked = Locked.model_validate(visit.notebook.table("camera.locked."))
    source = str(visit.notebook.get("camera.source")) if source is None else source
    camera = OpenCvCamera(CameraTable(kind="opencv", source=source, latency_ms=LATE_MS, locked=locked), visit.clock)
    async with identified(camera):
        yield camera


def found_settings(device: int, settle_s: float) -> dict[str, float]:
    """What a device chose by itself within `settle_s`, by the names of `Locked`. Blocks for that long.

    A setting that the device does not have is left out.
    """
    capture = cv2.VideoCapture(device)
    try:
        until_s = time.monotonic() + settle_s
        while time.monotonic() < until_s and capture.read()[0]:
            pass
        settings = {name: float(capture.get(getattr(cv2, number))) for name, (number, *_) in PROPERTIES.items()}
    finally:
        capture.release()
    return {name: value for name, value in settings.items() if value > 0.0 or (name == "exposure" and value < -0.5)}


async def still(camera: OpenCvCamera, clock: Clock) -> Gray:
    """A picture that was taken after now, however late the camera is."""
    return (await camera.fresh(Stamp(clock.now_ns()))).image


@contextlib.asynccontextmanager
async def shown_live(visit: Visit, camera: OpenCvCamera) -> AsyncGenerator[None]:
    """Show what the camera sees until the block ends."""

    def show(frame: Frame) -> None:
        visit.live = frame.image

    try:
        async with each_frame(camera, [show]):
            yield
    finally:
        visit.live = None
