"""Press a Chinese brush with a robot arm, record it, and measure how well a stroke model predicts the ink.

The names below are what one types in a notebook; docs/python.md shows them. Each is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # `typing` alone takes a third of the time that this import may
if TYPE_CHECKING:
    from brushloop.calibrate.calibrated import Calibrated
    from brushloop.calibrate.errors import CalibrationError, CaptureRefused
    from brushloop.calibrate.fit.command import BrushFit
    from brushloop.calibrate.notebook import (
        RecordedPress,
        Session,
        calibrate_session,
        fit,
        predict,
        recover,
        validate,
    )
    from brushloop.collect.errors import CollectAborted, ConfigError
    from brushloop.collect.start import collect_session
    from brushloop.drivers.loopback import LoopbackRig, simulate
    from brushloop.model.ccdbsm import Brush, DomainError
    from brushloop.model.generator.stroke import models
    from brushloop.model.similarity import Similarity, compare
    from brushloop.model.strokes import Prediction
    from brushloop.sessions.errors import SessionDamaged, SessionError
    from brushloop.sessions.records import Condition

_NAMES = {
    "brushloop.calibrate.calibrated": ("Calibrated",),
    "brushloop.calibrate.errors": ("CalibrationError", "CaptureRefused"),
    "brushloop.calibrate.fit.command": ("BrushFit",),
    "brushloop.calibrate.notebook": (
        *("RecordedPress", "Session", "calibrate_session", "fit", "predict", "recover", "validate"),
    ),
    "brushloop.collect.errors": ("CollectAborted", "ConfigError"),
    "brushloop.collect.start": ("collect_session",),
    "brushloop.drivers.loopback": ("LoopbackRig", "simulate"),
    "brushloop.model.ccdbsm": ("Brush", "DomainError"),
    "brushloop.model.generator.stroke": ("models",),
    "brushloop.model.similarity": ("Similarity", "compare"),
    "brushloop.model.strokes": ("Prediction",),
    "brushloop.sessions.records": ("Condition",),
    "brushloop.sessions.errors": ("SessionDamaged", "SessionError"),
}

__all__ = [
    "Brush",
    "BrushFit",
    "Calibrated",
    "CalibrationError",
    "CaptureRefused",
    "CollectAborted",
    "Condition",
    "ConfigError",
    "DomainError",
    "LoopbackRig",
    "Prediction",
    "RecordedPress",
    "Session",
    "SessionDamaged",
    "SessionError",
    "Similarity",
    "calibrate_session",
    "collect_session",
    "compare",
    "fit",
    "models",
    "predict",
    "recover",
    "simulate",
    "validate",
]


def __getattr__(name: str) -> object:
    for module, names in _NAMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(module), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
