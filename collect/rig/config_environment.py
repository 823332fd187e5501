"""Values of `rig.toml` that the environment sets: which variable sets what, and the ones that set nothing."""

from __future__ import annotations

import os

from pydantic_settings import BaseSettings, EnvSettingsSource, SettingsError

from collect.errors import ConfigError
from collect.rig.config_names import models_at, nearest, paths

PREFIX, DELIMITER = "BRUSHLOOP_", "__"


def overrides(settings: type[BaseSettings]) -> dict[tuple[str, ...], str]:
    """Variable by the path that it sets: `("robot", "port")` -> `BRUSHLOOP_ROBOT__PORT`.

    Raises `ConfigError` for a variable whose table or top field is not there: pydantic would pass it over in silence.
    """
    found: dict[tuple[str, ...], str] = {}
    for name in sorted(os.environ):
        if not name.upper().startswith(PREFIX):
            continue
        path = tuple(name[len(PREFIX) :].lower().split(DELIMITER))
        if path[0] not in settings.model_fields or (len(path) > 1 and not models_at(settings, path[:1])):
            # Compared without the prefix, which would make all of them alike.
            meant = nearest(DELIMITER.join(path), [DELIMITER.join(known) for known in paths([settings])])
            hint = f"; did you mean {PREFIX}{meant.upper()}?" if meant else f": {PREFIX}TABLE{DELIMITER}FIELD would"
            raise ConfigError(place(name), "", f"sets nothing of rig.toml{hint}")
        found[path] = name
    return found


def place(name: str) -> str:
    """A variable as refusals name it."""
    return f"environment variable {name}"


def unreadable(settings: type[BaseSettings], error: SettingsError) -> ConfigError:
    """The refusal of a variable whose text is not what a list or a table is written as."""
    for path, name in overrides(settings).items():
        source = EnvSettingsSource(settings)
        source.env_vars = {name.lower(): os.environ[name]}
        try:
            source()
        except SettingsError:
            shown = os.environ[name]
            shown = shown if len(shown) <= 80 else shown[:77] + "..."
            return ConfigError(place(name), ".".join(path), f"is not JSON, as [40.0, 24.0] is (given: {shown!r})")
    return ConfigError("environment", "", f"{error}".splitlines()[0])
