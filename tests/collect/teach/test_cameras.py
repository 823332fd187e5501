"""The pictures of several cameras in one, for the person who chooses between them."""

from __future__ import annotations

import numpy as np

from brushloop.collect.teach.cameras import NUMBER_PX, TILE_PX, side_by_side


def test_a_picture_of_every_camera_is_shown_whatever_its_size() -> None:
    wide, high, small = (
        np.full(size, gray, np.uint8) for size, gray in (((720, 1280), 90), ((960, 540), 140), ((48, 64), 190))
    )
    width_px, height_px = TILE_PX
    shown = side_by_side([wide, high, small])
    assert shown.shape == (2 * height_px, 2 * width_px)
    below_its_number = NUMBER_PX + 20
    assert shown[below_its_number, 100] == 90
    assert shown[below_its_number, width_px + 100] == 140
    assert shown[height_px + below_its_number, 100] == 190
    assert (shown[:NUMBER_PX, :NUMBER_PX] == 255).any(), "its number"
    assert side_by_side([wide]).shape == (height_px, width_px)
