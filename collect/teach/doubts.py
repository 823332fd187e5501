"""What the notebook of a rig says about its own gaps, for the page of `brushloop rig check`."""

from __future__ import annotations

from collections.abc import Iterator

from collect.rig.plausible import Check, unmeasured
from collect.teach.store import STEPS, Notebook

UNKNOWN = "not "
"""Beginning of the text for a value that was taken over without a measurement."""


def gaps(notebook: Notebook) -> Iterator[Check]:
    """Steps that were not finished, and values that were taken over from a pendant or a default."""
    if not notebook.values:
        return
    for step in STEPS:
        if step not in notebook.done:
            arm = " --arm" if step == "proof" else ""
            yield unmeasured(f"step {step}", "not done since something was taught", f"brushloop rig teach {step}{arm}")
    for field, taught in notebook.values.items():
        if taught.known.startswith(UNKNOWN) and not field.startswith("aside."):
            yield unmeasured(field, f"{taught.value} {taught.unit}".rstrip(), f"{taught.how}, {taught.known}")
