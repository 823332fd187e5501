"""Formulas that hold for numpy arrays and torch tensors alike: the arguments decide which of the two computes.

With a tensor among its arguments a formula computes in torch and carries gradients, else it computes in numpy. torch is
never imported for it, so only those who want gradients wait for torch.
"""

from __future__ import annotations

import functools
import sys
from typing import Any

import numpy as np

Array = Any
"""An array of numpy or a tensor of torch; where a parameter is meant, a number as well."""


def library(*values: Array) -> Any:
    """The library that computes with these values: torch if one of them is a tensor, else numpy."""
    torch = sys.modules.get("torch")
    return torch if torch is not None and any(isinstance(value, torch.Tensor) for value in values) else np


def like(values: Array, other: Array) -> Array:
    """Constant values as an array of the library, dtype and device of `other`."""
    if library(other) is np:
        return np.asarray(values, other.dtype)
    return library(other).as_tensor(values, dtype=other.dtype, device=other.device)


def as_batch(*values: Array) -> tuple[Array, ...]:
    """All values as (B,) arrays of one floating dtype, broadcast to each other.

    In numpy the dtype is float64; in torch it is that of the floating-point tensors, else float64, and the device is
    that of the first tensor. Raises ValueError for a value of two or more dimensions.
    """
    xp = library(*values)
    if xp is np:
        batch = [np.atleast_1d(np.asarray(value, np.float64)) for value in values]
    else:
        tensors = [value for value in values if isinstance(value, xp.Tensor)]
        floating = [tensor.dtype for tensor in tensors if tensor.is_floating_point()]
        dtype = functools.reduce(xp.promote_types, floating) if floating else xp.float64
        batch = [xp.atleast_1d(xp.as_tensor(value, dtype=dtype, device=tensors[0].device)) for value in values]
    if any(part.ndim > 1 for part in batch):
        raise ValueError(f"stroke parameters are scalars or (B,), got shapes {[tuple(part.shape) for part in batch]}")
    return tuple(np.broadcast_arrays(*batch) if xp is np else xp.broadcast_tensors(*batch))


def as_numpy(values: Array) -> Any:
    """The values as a C-contiguous float64 array of numpy, without gradients."""
    if library(values) is not np:
        values = values.detach().cpu().numpy()
    return np.asarray(values, np.float64, order="C")


def safe_sqrt(value: Array) -> Array:
    """The square root of max(value, 0), any shape, with gradient 0 rather than infinity where value <= 0."""
    xp = library(value)
    positive = value > 0
    # Both branches of `where` are differentiated, so the unused one has to be finite as well.
    return xp.where(positive, xp.sqrt(xp.where(positive, value, xp.ones_like(value))), xp.zeros_like(value))
