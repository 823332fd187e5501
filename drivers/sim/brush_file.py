"""A brush described in a TOML file: `brushloop sim --brush FILE`.

```toml
name = "our goat-hair brush no. 3, simulated"   # in every recording and report made with it
[brush]
stiffness_n_mm2 = 150.0                         # the fields of `BrushSpec`; a field that is left out has its default
[camera]
noise = 1.4                                     # gray levels; may be left out
[quality]                                       # for the `[quality]` of the rig.toml; may be left out
head_mm = 2.2
misplaced_mm = 4.0
```
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.drivers.sim.config import SoundHead
from brushloop.drivers.sim.described import SimFileError, complaint

MAX_BYTES = 256 * 1024
MAX_NOISE_GRAY = 30.0
LOOPBACK = "loopback"
"""Name of the brush whose constants are the defaults of `BrushSpec`."""
PAPER = "paper"
"""Name under which the brush of `PAPER_FILE` is chosen."""
PAPER_FILE = Path(__file__).with_name("brush") / "paper_brush.toml"
"""The brush made to agree with the paper's Table 2 (`python -m bench paper-brush`)."""


@dataclass(frozen=True, slots=True)
class NamedBrush:
    """A brush, and the name under which it is recorded."""

    spec: BrushSpec
    name: str
    noise_gray: float | None = None
    """Standard deviation of the camera's noise that was measured with it; None for the rig's default."""
    head: SoundHead | None = None
    """Where its sound marks begin; None for the default of `rig.toml`."""


class _Camera(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    noise: Annotated[float, Field(ge=0.0, le=MAX_NOISE_GRAY)]


class _File(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    name: Annotated[str, Field(min_length=1, max_length=120, pattern=r'^[^\x00-\x1f\x7f"\\]+$')]
    brush: BrushSpec
    camera: _Camera | None = None
    quality: SoundHead | None = None


def load_brush(path: Path, seed: int = BrushSpec().seed) -> NamedBrush:
    """Read the file, or take one of the shipped brushes if `path` is just `paper` or `loopback`.

    `seed` is that of the individual for `loopback`; any other brush has its own. Raises `SimFileError`.
    """
    if str(path) == LOOPBACK:
        return NamedBrush(BrushSpec(seed=seed), "")
    found = _read(PAPER_FILE if str(path) == PAPER else path)
    return NamedBrush(found.brush, found.name, None if found.camera is None else found.camera.noise, found.quality)


def _read(path: Path) -> _File:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SimFileError(path, "", f"is larger than {MAX_BYTES} bytes")
        return _File.model_validate(tomllib.loads(data.decode("utf-8")))
    except FileNotFoundError:
        raise SimFileError(path, "", "no such file") from None
    except OSError as error:
        raise SimFileError(path, "", error.strerror or str(error)) from None
    except ValidationError as error:
        raise SimFileError(path, *complaint(error)) from None
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise SimFileError(path, "", f"is not TOML: {error}") from None
