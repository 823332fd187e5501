"""The TOML file that describes a simulated brush, and the shipped brushes.

docs/loopback-brush.md shows such a file; a field of `BrushSpec` that it leaves out has its default.
"""

import tomllib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from brushloop.drivers.loopback import RigRefused
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import BrushSpec


def complaint(error: ValidationError) -> str:
    """A field and what is wrong with it, in one printable line; an unknown key first, as it is often a misspelt one."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    field = ".".join(str(part) for part in first["loc"])
    value = "" if first["type"] in ("missing", "value_error") else f" (given: {str(first['input'])[:60]!r})"
    more = f"; and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    line = ": ".join(filter(None, (field, f"{first['msg'].removeprefix('Value error, ')}{value}{more}")))
    return "".join(char if char.isprintable() else "?" for char in line)[:300]


MAX_BYTES = 256 * 1024
LOOPBACK = "loopback"
"""Name of the brush whose constants are the defaults of `BrushSpec`."""
LIKE_TABLE_2 = "table2"
"""Name under which the brush of `TABLE_2_FILE` is chosen."""
TABLE_2_FILE = Path(__file__).with_name("table2_brush.toml")
"""The brush made to agree with the paper's Table 2 (`python -m bench table2-brush`)."""


class CameraNoise(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """What the camera added to the photographs of a brush."""

    noise: Annotated[float, Field(ge=0.0, le=30.0)]
    """Standard deviation, in gray levels."""


class SoundHead(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """The `[quality]` settings of a rig.toml that depend on the brush."""

    head_mm: Annotated[float, Field(ge=-20.0, le=20.0)]
    """How far a sound mark begins behind the zero-touch point, on the side away from its tip."""
    misplaced_mm: Annotated[float, Field(ge=0.1, le=20.0)]
    """Distance from there at which a mark counts as misplaced."""


class BrushFile(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """A brush, and the name under which it is recorded."""

    name: Annotated[str, Field(min_length=1, max_length=120, pattern=r'^[^\x00-\x1f\x7f"\\]+$')]
    brush: BrushSpec
    camera: CameraNoise | None = None
    """As it was measured with this brush; None for the rig's default."""
    quality: SoundHead | None = None
    """Where its sound marks begin; None for the default of `rig.toml`."""
    misfit: Misfit | None = None


def load_brush(path: Path, seed: int = BrushSpec().seed) -> BrushFile:
    """Read the file, or take one of the shipped brushes if `path` is just `table2` or `loopback`.

    `seed` is that of the individual for `loopback`; any other brush has its own. Raises `RigRefused`, or OSError.
    """
    if str(path) == LOOPBACK:
        return BrushFile(name=f"simulated bristle bundle, seed {seed}", brush=BrushSpec(seed=seed))
    path = TABLE_2_FILE if str(path) == LIKE_TABLE_2 else path
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise RigRefused(f"{path}: is larger than {MAX_BYTES} bytes")
        return BrushFile.model_validate(tomllib.loads(data.decode("utf-8")))
    except FileNotFoundError:
        shipped = f"{LOOPBACK} and {LIKE_TABLE_2} are shipped, any other is a brush.toml"
        raise RigRefused(f"{path}: no such file: {shipped}") from None
    except ValidationError as error:
        raise RigRefused(f"{path}: {complaint(error)}") from None
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise RigRefused(f"{path}: is not TOML: {error}") from None
