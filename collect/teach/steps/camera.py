"""Step 2: the camera, the print of the board, and the lens by photographs of the board held in hand."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.intrinsics import (
    GOOD_VIEWS,
    GRID,
    LensFile,
    distinct_views,
    fit_lens,
    guidance,
    held,
    nominal_normals,
)
from brushloop.calibrate.board.spec import BoardSpec, describe
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_gray
from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Choice
from brushloop.collect.teach.cameras import (
    Gray,
    devices,
    frame_rate_hz,
    locked_settings,
    opened,
    side_by_side,
    still,
    taught_camera,
)
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.guide import Brought, Picture, Target
from brushloop.collect.teach.steps.sheet import board_of
from brushloop.collect.teach.store import Notebook, StepName
from brushloop.drivers.errors import DeviceError

Take = Callable[[], Awaitable[Gray]]
VIEW = "aside.lens_view_"
"""Beginning of the names of the photographs of the held board: their digests."""
ASIDE = ("aside.frame_rate_hz", "aside.lens_folder", VIEW)
MOST_VIEWS = 20
HOLD = (
    "flat in the middle of the picture",
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
MIRRORED = (
    "Switch mirroring (`flip`) off in the camera's own set-up, or take the mirror out of its way; then try again."
)
OTHER_PRINT = (
    "Count the squares of the print again, the outermost ones too, and measure one; then teach the camera again."
)


class CameraStep(Step):
    """Source, settings, frame rate, print of the board, lens."""

    name: StepName = "camera"
    title = "Find the camera"
    minutes = 12
    needs: tuple[StepName, ...] = ("arm",)

    async def teach(self, day: Day) -> None:
        """Ask for source and print, measure the rest. Raises `CannotTeach`, `DeviceError`, `CalibrationError`."""
        if "board.dictionary" not in day.notebook.values:
            await self._print(day)
        if "camera.source" not in day.notebook.values:
            await self._source(day)
        async with taught_camera(day.notebook, day.clock) as camera:
            await day.working("counting frames, looking for the board")
            if "aside.frame_rate_hz" not in day.notebook.values:
                rate_hz = await frame_rate_hz(camera)
                day.keep("camera", "aside.frame_rate_hz", rate_hz, "frames counted", unit="Hz")
                await day.say(f"{rate_hz:.1f} frames per second; the delay is measured in the last step, by the arm.")
            picture = await still(camera, day.clock)
            await self._first_look(day, picture)
            folder = self._folder(day)
            fitted = await self._lens(day, folder, lambda: still(camera, day.clock))
        if fitted is not None:
            await self._keep_lens(day, fitted)

    def _folder(self, day: Day) -> Path:
        """Where the photographs of the lens are, so that a resumed session does not take them again."""
        if "aside.lens_folder" not in day.notebook.values:
            names = (f"{day.rig_path.stem}.lens-{number}" for number in itertools.count(1))
            name = next(name for name in names if not (day.rig_path.parent / name).exists())
            day.keep("camera", "aside.lens_folder", name, "photographs of the board held in hand")
        folder = day.rig_path.parent / str(day.notebook.get("aside.lens_folder"))
        folder.mkdir(exist_ok=True)
        return folder

    async def _source(self, day: Day) -> None:
        found = devices()
        if found:
            await day.say(f"Video devices of this computer: {', '.join(found)}")
        question = "Address of the camera's stream, as http://192.0.2.8/stream.mjpg (several: separated by spaces)"
        typed = (await day.guide.text(question, "")).split()
        seen = {source: await self._looked_at(day, source) for source in dict.fromkeys([*typed, *found])}
        usable = {source: look for source, look in seen.items() if look is not None}
        if not usable:
            raise CannotTeach("no camera gives a picture.", "Check power, cable and address; then try again.")
        source = max(usable, key=lambda one: usable[one][0])
        if len(usable) > 1:
            keys = {str(number): one for number, one in enumerate(usable, 1)}
            choices = tuple(Choice(key, one) for key, one in keys.items())
            best = next(key for key, one in keys.items() if one == source)
            pictures = side_by_side([picture for _, picture in usable.values()])
            await day.say(f"{len(usable)} cameras give a picture, numbered as below.", picture=pictures)
            source = keys[await day.guide.choose("Which of them looks at the sheet?", choices, best)]
        settings = await locked_settings(source)
        day.keep("camera", "camera.kind", "opencv", "the only kind")
        for name, value in settings.items():
            field = f"camera.locked.{name}"
            whole = name in ("width", "height")
            day.keep("camera", field, int(value) if whole else value, "chosen by the camera itself, locked, read back")
        if not settings:
            await day.say(
                "The settings of a stream cannot be set from here: switch automatic exposure, white balance and focus "
                "off in the camera's own set-up.",
                tone="warning",
            )
        # Last, so that a session that is interrupted before begins again with the source.
        day.keep("camera", "camera.source", source, "typed or found, and its picture was seen")

    async def _looked_at(self, day: Day, source: str) -> tuple[int, Gray] | None:
        """Show a picture of a camera; return how many corners of the board it shows, and the picture, if any."""
        await day.working(f"waiting for a picture of {source}")
        try:
            async with opened(source, day.clock) as camera:
                picture = await still(camera, day.clock)
        except DeviceError as error:
            await day.say(f"{source}: {error.what}", tone="warning")
            return None
        height, width = picture.shape
        try:
            corners = len((await asyncio.to_thread(find_board, picture, board_of(day.notebook), source)).ids)
            what = f"{corners} corners of the board are seen"
        except CalibrationError as error:
            corners, what = 0, error.what
        await day.say(f"{source}: {width} x {height} px; {what}", picture=picture)
        return corners, picture

    async def _print(self, day: Day) -> None:
        await day.say("The board: a print of `brushloop camera board`. Its name stands along its lower edge.")
        across = await day.guide.number("Squares along its longer side, as printed", "squares", 3, 50, None)
        along = await day.guide.number("Squares along its shorter side, as printed", "squares", 3, 50, None)
        square_mm = await day.guide.number(
            "Side of a square (ten of them by calipers, divided by ten)", "mm", 2.0, 100.0, None
        )
        marker_mm = await day.guide.number("Side of a marker", "mm", 1.0, 100.0, 0.75 * square_mm)
        dictionary = await day.guide.text("Markers of the print", "DICT_5X5_1000")
        how = "typed from the board's print"
        try:
            BoardSpec(
                squares=(int(across), int(along)),
                square_mm=square_mm,
                marker_mm=marker_mm,
                dictionary=dictionary,
                origin_mm=(0.0, 0.0),
            )
        except ValueError as error:
            raise CannotTeach(f"no such board: {error}".splitlines()[0] + ".", "Read the print again.") from None
        with day.together():
            day.keep("camera", "board.squares", [int(across), int(along)], how)
            day.keep("camera", "board.square_mm", square_mm, how, unit="mm")
            day.keep("camera", "board.marker_mm", marker_mm, how, unit="mm")
            day.keep("camera", "board.dictionary", dictionary, how)

    async def _first_look(self, day: Day, picture: Gray) -> None:
        """The board where it lies: a mirrored camera and a wrong print show at once."""
        spec = board_of(day.notebook)
        try:
            await asyncio.to_thread(find_board, picture, spec, "camera")
        except CalibrationError as error:
            if "mirrored" in error.what:
                raise CannotTeach(f"{error.what}.", MIRRORED) from None
            if "another board" in error.what or "arranged" in error.what:
                self._forget_print(day)
                raise CannotTeach(f"{error.what}.", OTHER_PRINT) from None
            await day.say(f"The board is not seen yet: {error.what}", picture=picture, tone="warning")

    def _forget_print(self, day: Day) -> None:
        day.save(day.notebook.without("board."))

    async def _lens(self, day: Day, folder: Path, take: Take) -> LensFile | None:
        """Have the board held before the camera until the lens is known and its picture covered.

        None if the person skips it from the start: a lens without distortion needs no file.
        """
        spec, views = board_of(day.notebook), list[BoardView]()
        for name in taken(day.notebook, folder):
            views.append(await asyncio.to_thread(find_board, read_gray(folder / name), spec, name))
        for index in range(MOST_VIEWS):
            name = f"{index:02d}.png"
            if name in taken(day.notebook, folder):
                continue
            if len(views) >= GOOD_VIEWS and not still_missing(views):
                break
            where = HOLD[index] if index < len(HOLD) else "where it is still missing"
            if not await self._held(day, folder / name, where, take, views) and not views:
                await day.say("Without a lens file, straight lines must look straight in the picture.", tone="warning")
                return None
            if views and (todo := still_missing(views)):
                await day.say(*todo, picture=coverage_picture(views))
        await day.working("computing the lens")
        digests = {name: digest(folder / name) for name in taken(day.notebook, folder)}
        file = await asyncio.to_thread(fit_lens, views, describe(spec), digests, {})
        for warning in (*file.warnings, *file.guidance):
            await day.say(warning, tone="warning")
        return file

    async def _held(self, day: Day, path: Path, where: str, take: Take, views: list[BoardView]) -> bool:
        """Take one photograph of the held board; False where the person skips it."""
        target = Target("hold-board", int(path.stem), may_skip=True)
        how = f"Cover the sheet, and hold the board before the camera, {where}, all of it sharp; keep still."
        if await day.guide.bring(target, how) is not Brought.DONE:
            return False
        await day.working("looking for the board in the picture")
        picture = await take()
        try:
            view = await asyncio.to_thread(find_board, picture, board_of(day.notebook), path.name)
        except CalibrationError as error:
            if "mirrored" in error.what:
                raise CannotTeach(f"{error.what}.", MIRRORED) from None
            await day.say(f"not used: {error.what}", picture=picture, tone="warning")
            return True
        await asyncio.to_thread(cv2.imwrite, str(path), picture)
        day.keep("camera", VIEW + path.stem, digest(path), "photograph of the board held in hand")
        views.append(view)
        return True

    async def _keep_lens(self, day: Day, file: LensFile) -> None:
        path = file.save(day.rig_path.parent)
        reach = file.focal_reach_px
        day.keep(
            "camera",
            "camera.lens_file",
            str(path.relative_to(day.rig_path.parent)),
            f"fitted to {len(file.residuals_px)} photographs of the board held in {file.ways} ways",
            known=f"residual {file.rms_px:.2f} px"
            + ("" if reach is None else f", focal length to +-{max(reach):.1f} px (95 %)"),
        )
        await day.say(f"Lens: residual {file.rms_px:.2f} px over {len(file.residuals_px)} photographs.")

    def forget(self, notebook: Notebook) -> Notebook:
        """Without source, settings, print and lens; the photographs of the lens are taken again."""
        return notebook.without(
            "camera.", "board.squares", "board.square_mm", "board.marker_mm", "board.dictionary", *ASIDE
        )

    def summary(self, notebook: Notebook) -> str:
        """Source and rate."""
        return f"{notebook.get('camera.source')}, {notebook.number('aside.frame_rate_hz'):.0f} frames/s"


def taken(notebook: Notebook, folder: Path) -> list[str]:
    """Names of the photographs of the held board that are still as they were taken, and were not taken back."""
    names = [f"{field.removeprefix(VIEW)}.png" for field in notebook.values if field.startswith(VIEW)]
    return sorted(
        name
        for name in names
        if (folder / name).is_file() and digest(folder / name) == notebook.get(VIEW + name.removesuffix(".png"))
    )


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


WIDTH_PX = 320
SEEN, UNSEEN, CORNER = 90, 40, 255


def still_missing(views: Sequence[BoardView]) -> tuple[str, ...]:
    """Instructions for further photographs; empty where the views suffice. At least one view."""
    distinct, _ = distinct_views(views)
    normals = nominal_normals(distinct)
    slants_deg = np.degrees(np.arccos(np.clip(normals[:, 2], -1.0, 1.0))).tolist()
    return guidance(distinct, slants_deg, int(held(normals).max()) + 1)


def coverage_picture(views: Sequence[BoardView]) -> Picture:
    """A map of the camera's picture: corners seen so far as dots, and parts where none was seen darker."""
    width, height = views[0].size_px
    scale = WIDTH_PX / width
    rows_px = round(height * scale)
    picture = np.full((rows_px, WIDTH_PX), SEEN, np.uint8)
    places = np.concatenate([view.pixels for view in views]) * scale
    columns, rows = GRID
    for row in range(rows):
        for column in range(columns):
            left, right = WIDTH_PX * column // columns, WIDTH_PX * (column + 1) // columns
            top, bottom = rows_px * row // rows, rows_px * (row + 1) // rows
            x, y = places[:, 0], places[:, 1]
            if not ((x >= left) & (x < right) & (y >= top) & (y < bottom)).any():
                picture[top:bottom, left:right] = UNSEEN
    for x, y in places.tolist():
        cv2.circle(picture, (round(x), round(y)), 1, (CORNER,), -1)
    return picture
