"""The self-check of a rig, put into any protocol that marks the paper."""

from __future__ import annotations

import contextlib

from collect.protocols.steps import Protocol, Step, StepKind

KNOWING = frozenset({StepKind.ZERO_TOUCH, StepKind.TOUCH, StepKind.BOARD})
"""Paper and board must be known before it."""


def with_self_check(protocol: Protocol) -> Protocol:
    """The same protocol, with a SELF_CHECK step before the first that is for a mark."""
    step = next(protocol)
    checked = False
    with contextlib.suppress(StopIteration):
        while True:
            if not checked and step.kind not in KNOWING:
                yield Step(StepKind.SELF_CHECK, 0)
                checked = True
            step = protocol.send((yield step))
