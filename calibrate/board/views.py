"""Which views of a board count: photographs that show it where another does, and ways in which it is held."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibrate.board.detect import View
from calibrate.board.lens import Floats, unknown_lens
from calibrate.board.scale import homography

Ways = NDArray[np.int64]
SAME_SHARE = 0.0015
"""Of the image's longer side. Corners that lie nearer are the same but for noise: 1 px of 640."""
DISTINCT_DEG = 5.0
"""Boards less than this apart are held alike: parallel planes tell a lens's focal length no more than one of them."""


def named(photographs: Sequence[Path]) -> dict[str, Path]:
    """Each photograph by a name of its own: the file's, with its folder where there are several, else numbered."""
    folders = len({path.parent for path in photographs})
    found: dict[str, Path] = {}
    for path in photographs:
        name = plain = f"{path.parent.name}/{path.name}" if folders > 1 else path.name
        number = 1
        while name in found:
            number += 1
            name = f"{plain} ({number})"
        found[name] = path
    return found


def told_apart(views: Iterable[View]) -> tuple[list[View], dict[str, str]]:
    """The views that show the board somewhere else than those before; of each other one, which it repeats."""
    kept, again = list[View](), dict[str, str]()
    for view in views:
        twin = next((one for one in kept if _same(one, view)), None)
        if twin is None:
            kept.append(view)
        else:
            again[view.name] = f"shows the board where {twin.name} does: they count once"
    return kept, again


def held(normals: Floats) -> Ways:
    """(n,) number of the way in which each board is held, by the (n, 3) unit vectors out of them."""
    first, ways = list[Floats](), list[int]()
    for normal in normals:
        near = [k for k, one in enumerate(first) if float(normal @ one) > np.cos(np.radians(DISTINCT_DEG))]
        ways.append(near[0] if near else len(first))
        if not near:
            first.append(normal)
    return np.array(ways, np.int64)


def nominal_normals(views: Sequence[View]) -> Floats:
    """(n, 3) unit vectors out of each board as a straight lens of one image width sees them.

    Rough, but no lens that was fitted to boards that are all held alike can tell them apart here.
    """
    rays = np.linalg.inv(unknown_lens(views[0].size_px).matrix)
    found = list[Floats]()
    for view in views:
        across, along, _ = (rays @ homography(view.board_mm, view.pixels, view.name)).T
        normal = np.cross(across, along)
        found.append(normal / (np.linalg.norm(normal) * (-1.0 if normal[2] < 0.0 else 1.0)))
    return np.array(found)


def reasons(why: Mapping[str, str]) -> list[str]:
    """What is wrong with which photographs, once each."""
    names: dict[str, list[str]] = {}
    for name, told in why.items():
        names.setdefault(told, []).append(name)
    return [f"{', '.join(those)}: {told}" for told, those in names.items()]


def _same(one: View, other: View) -> bool:
    shared, here, there = np.intersect1d(one.ids, other.ids, return_indices=True)
    if one.size_px != other.size_px or 2 * len(shared) < min(len(one.ids), len(other.ids)):
        return False
    apart = np.linalg.norm(one.pixels[here] - other.pixels[there], axis=1)
    return bool(np.median(apart) < SAME_SHARE * max(one.size_px))
