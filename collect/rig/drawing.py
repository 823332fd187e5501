"""What pictures of the rig and of plans have in common: file formats, colours, axes in millimetres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from brushloop.collect.errors import ConfigError

Axes = Any
"""Axes of matplotlib, whose types are incomplete."""
ENDINGS = (".png", ".svg", ".pdf", ".jpg")
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
"""From the palette of Okabe and Ito, which colour-blind people can tell apart; the marks differ in shape too."""
PAPER = "#fbf7ea"


def check_picture(path: Path) -> None:
    """Raise `ConfigError` if no picture can be written to this path. Called before anything is computed."""
    if path.suffix.lower() not in ENDINGS:
        raise ConfigError("--picture", "", f"{path} must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if not path.parent.is_dir():
        raise ConfigError("--picture", "", f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ConfigError("--picture", "", f"{path} is a folder")


def finish(axes: Axes, title: str, along: tuple[str, str] = ("x mm", "y mm")) -> None:
    """Equal scales, a title, and labels that say what runs `along` the axes."""
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(along[0], fontsize=8)
    axes.set_ylabel(along[1], fontsize=8)
    axes.tick_params(labelsize=8)
