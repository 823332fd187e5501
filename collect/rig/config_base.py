"""What every table of `rig.toml` and `protocol.toml` is made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

MOST = 1e6
"""Of any number: a length of a kilometre is a slip of the pen, to be told as one."""
Positive = Annotated[float, Field(gt=0.0, le=MOST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
Range = tuple[Finite, Finite]


class Config(BaseModel):
    """Base: frozen, extra keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")
