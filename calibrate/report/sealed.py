"""Reports as data that carry the digest of their own contents: one that was edited is told from one that was not.

The digest is no signature: it guards what was measured, and on what kind of ink, against being edited by accident.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, cast

from pydantic import BaseModel, ConfigDict, ValidationError

from calibrate.errors import CalibrationError, invalid
from calibrate.files import read_bounded


class Sealed(BaseModel):
    """Base: frozen, nothing unknown is let in. A subclass gives `format` its FORMAT as default."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    FORMAT: ClassVar[str]
    MADE_BY: ClassVar[str]
    """The command that writes such a file."""

    format: str
    digest: str = ""
    """SHA-256 of everything else."""

    def sealed(self) -> Self:
        """The same with its digest."""
        return self.model_copy(update={"digest": _digest(self.model_dump(mode="json"))})

    @property
    def intact(self) -> bool:
        """Whether the digest is that of the contents."""
        return self.digest == _digest(self.model_dump(mode="json"))

    def to_json(self) -> str:
        """As it is written to disk."""
        return json.dumps(self.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"


S = TypeVar("S", bound=Sealed)


def load_sealed(path: Path, kind: type[S], most_bytes: int) -> S:
    """Read a report as data. Raises `CalibrationError`, naming the file, where it is none, is too new or was edited."""
    data = read_bounded(path, most_bytes)
    named: dict[str, Any] = {}
    found = ""
    try:
        told: Any = json.loads(data)
        if isinstance(told, dict):
            named = cast("dict[str, Any]", told)
            # Of the file, not of the model: a field that is new since the file was written is no edit.
            found = _digest(named)
    except (ValueError, RecursionError):  # no JSON, or text that is no Unicode: said below
        named = {}
    if "format" not in named or "digest" not in named:
        raise CalibrationError(str(path), f"is no report with a digest: write it with `{kind.MADE_BY}`")
    if named["format"] != kind.FORMAT:
        raise CalibrationError(str(path), f"format is {str(named['format'])[:40]!r}, expected {kind.FORMAT!r}")
    try:
        made = kind.model_validate(named)
    except ValidationError as error:
        raise invalid(str(path), error) from None
    if named["digest"] != found:
        raise CalibrationError(str(path), "was edited: its digest is not that of its contents")
    return made


def _digest(contents: dict[str, Any]) -> str:
    text = json.dumps(contents | {"digest": ""}, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
