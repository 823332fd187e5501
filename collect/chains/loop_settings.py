"""What a loop was begun with, on disk: a loop that goes on must be the same loop."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from calibrate.files import read_bounded, write_whole
from collect.errors import ConfigError
from sessions.recording.schemas import BareName

FILE = "settings.json"


class Settings(BaseModel):
    """Everything that what is pressed again depends on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    original: str
    """Session id."""
    original_sha256: str
    fit: BareName
    """Digest of the brush fit that recovers depth and tilt."""
    height_range_mm: tuple[float, float]
    tilt_range_deg: tuple[float, float]
    repeats: int
    seed: int


def begun_with(folder: Path) -> Settings | None:
    """What a loop in that folder was begun with; None for a new one. Raises `ConfigError`."""
    path = folder / FILE
    if not path.exists():
        return None
    try:
        return Settings.model_validate_json(read_bounded(path))
    except ValidationError:
        raise ConfigError(path, "", "does not hold the settings of a loop: use another --out") from None


def keep(settings: Settings, folder: Path) -> None:
    """Write them down, or see that they are what was written down. Raises `ConfigError` and OSError."""
    begun = begun_with(folder)
    if begun is None:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / FILE, settings.model_dump_json(indent=2) + "\n")
        return
    for name in Settings.model_fields:
        was, now = getattr(begun, name), getattr(settings, name)
        if was != now:
            raise ConfigError(folder / FILE, name, f"this loop was begun with {was}, not {now}: use another --out")
