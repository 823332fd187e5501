"""Read board and lens from `rig.toml` for a registration, and write where the paper lies into it.

Only two values change in the text. Comments, order and everything else stay, and the old file is kept beside it.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import tomlkit
from pydantic import ValidationError

from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded, write_whole


@dataclass(frozen=True, slots=True)
class PaperLines:
    """Where the sheet lies, as two lines of `[paper]`."""

    origin_mm: tuple[float, float]
    """Lower left corner of the sheet in the base frame."""
    yaw_deg: float
    """From base x to paper x, counter-clockwise."""

    @property
    def values(self) -> dict[str, list[float] | float]:
        """Each field and its value, rounded to 0.001 mm and 0.0001 deg."""
        # Adding 0 turns -0.0 into 0.0.
        return {"origin_mm": [round(v, 3) + 0.0 for v in self.origin_mm], "yaw_deg": round(self.yaw_deg, 4) + 0.0}

    @property
    def toml(self) -> str:
        """The lines to paste into rig.toml."""
        return "\n".join(f"{name} = {value}" for name, value in self.values.items())


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig's configuration as text, with the board and the lens file that it names."""

    path: Path
    text: str
    board: BoardSpec
    lens_file: Path | None

    def with_paper(self, lines: PaperLines) -> str:
        """The text with these two values. Raises `CalibrationError` where there is no table `paper` to hold them."""
        document: Any = tomlkit.parse(self.text)
        if not isinstance(document.get("paper"), dict):
            what = "paper: is not a table; nothing is written. Enter by hand: " + ", ".join(lines.toml.splitlines())
            raise CalibrationError(str(self.path), what)
        for name, value in lines.values.items():
            document["paper"][name] = value
        return tomlkit.dumps(document)

    def write(self, lines: PaperLines) -> Path:
        """Write these two values; returns the path of the old file. Raises `CalibrationError` and OSError."""
        made = self.with_paper(lines)
        kept = free_name(self.path)
        with kept.open("xb") as file:
            file.write(self.text.encode())
        write_whole(self.path.resolve(), made)
        return kept


def read_rig(path: Path) -> RigFile:
    """Read a rig's configuration. Raises `CalibrationError` that names file and field."""
    try:
        text = read_bounded(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise CalibrationError(str(path), f"is not UTF-8 at byte {error.start}") from None
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise CalibrationError(str(path), f"is not TOML: {error}") from None
    try:
        board = BoardSpec.model_validate(tables.get("board"))
    except ValidationError as error:
        found = invalid("board", error)
        raise CalibrationError(
            str(path), f"board.{found.what}" if "board" in tables else "[board] is missing"
        ) from None
    camera = tables.get("camera")
    lens = cast("dict[str, Any]", camera).get("lens_file") if isinstance(camera, dict) else None
    return RigFile(path, text, board, path.parent / lens if isinstance(lens, str) else None)


def free_name(path: Path) -> Path:
    """An unused name beside the file."""
    number, kept = 1, path.with_name(f"{path.name}.bak")
    while kept.exists() or kept.is_symlink():
        number += 1
        kept = path.with_name(f"{path.name}.bak-{number}")
    return kept
