"""Pictures in sixels: drawn, and read back by a decoder that knows nothing of the encoder."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from textual.app import App, ComposeResult
from textual.drivers.headless_driver import HeadlessDriver
from textual.geometry import Size
from textual.pilot import Pilot

from collect.tui.pictures import SixelPicture
from collect.tui.sixel import NOTHING, SIXEL_LEVELS, lines_of, sixels


def drawn(sequence: str) -> NDArray[np.int64]:
    """What a terminal would draw: percent of each pixel, -1 where nothing is."""
    match = re.fullmatch(r'\x1bP0;1;0q"1;1;(\d+);(\d+)(.*)\x1b\\', sequence, re.DOTALL)
    assert match is not None
    width, height = int(match[1]), int(match[2])
    out = np.full((height + 6, width), -1)
    palette: dict[int, int] = {}
    x = y = colour = 0
    for token in re.finditer(r"#(\d+);2;(\d+);\d+;\d+|#(\d+)|!(\d+)(.)|([?-~])|([$-])", match[3]):
        if token[1]:
            palette[int(token[1])] = int(token[2])
        elif token[3]:
            colour = int(token[3])
        elif token[7] == "$":
            x = 0
        elif token[7] == "-":
            x, y = 0, y + 6
        else:
            times, sign = (int(token[4]), token[5]) if token[4] else (1, token[6])
            for row in range(6):
                if (ord(sign) - 63) >> row & 1:
                    out[y + row, x : x + times] = palette[colour]
            x += times
    assert (out[height:] == -1).all()
    return out[:height]


@pytest.mark.parametrize("shape", [(15, 8), (20, 61), (1, 1), (6, 300)])
def test_what_is_drawn_is_what_was_given(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    levels = rng.integers(-1, SIXEL_LEVELS, shape)
    levels[:, : shape[1] // 2] = NOTHING
    expected = np.where(levels == NOTHING, -1, np.round(100 * levels / (SIXEL_LEVELS - 1)).astype(int))
    assert np.array_equal(drawn(sixels(levels)), expected)


@pytest.mark.parametrize(("size", "lines"), [(Size(10, 4), 4), (Size(10, 40), 5), (Size(0, 4), 0)])
def test_a_picture_keeps_its_shape_and_never_reaches_below_its_lines(size: Size, lines: int) -> None:
    square = np.full((50, 50), 255, np.uint8)
    made = lines_of(square, size, (10, 20))
    assert len(made) == lines
    if made:
        assert {line.shape[0] for line in made} == {20}
        white = np.concatenate(made) == SIXEL_LEVELS - 1
        assert white.any(axis=0).sum() == white.any(axis=1).sum() == min(10 * size.width, 20 * size.height)


class Recorder(HeadlessDriver):
    """A terminal that keeps what is written to it."""

    written = ""
    is_headless = False

    def write(self, data: str) -> None:
        Recorder.written += data


class One(App[None]):
    CSS = "#picture { border-top: solid white; }"

    def compose(self) -> ComposeResult:
        yield SixelPicture("picture")


async def test_a_line_that_did_not_change_is_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Recorder, "written", "")
    images: list[str] = []

    async def show_two(pilot: Pilot[None]) -> None:
        picture = pilot.app.query_one("#picture", SixelPicture)
        first = np.zeros((200, 200), np.uint8)
        second = first.copy()
        second[105:110] = 255
        for image in (first, second):
            await pilot.pause()
            Recorder.written = ""
            picture.show(image)
            await pilot.pause()
            images.append(Recorder.written)
        pilot.app.exit()

    await One(driver_class=Recorder).run_async(size=(20, 10), auto_pilot=show_two)
    assert [written.count("\x1bP0;1;0q") for written in images] == [9, 1], "all below the border; the one that changed"
