"""A quality check: a stroke whose ink is unusually dark.

Yield such a check in `judge_mark` of `collect/photograph/checks.py`. A finding of its own needs a name in `Failure`
there, and its limit belongs in `QualityConfig` (`collect/rig/config.py`), so that a rig can set it. `docs/quality.md`
says what it measures.
"""

from __future__ import annotations

from brushloop.collect.photograph.checks import Failure
from brushloop.collect.photograph.measure import Mark
from brushloop.collect.rig.config import QualityConfig
from brushloop.sessions.records import Check

DARKEST_TONE = 0.97


def flooded(mark: Mark, limits: QualityConfig) -> Check:
    """Fail where the darkest quarter of the stroke reflects next to nothing: the ink stands on the paper."""
    del limits  # a real check reads its threshold from here
    passed = mark.tone < DARKEST_TONE
    reason = "" if passed else f"The ink stands on the paper (darkness {mark.tone:.2f}). Wipe the brush on the rim."
    return Check(name=Failure.FAINT, score=mark.tone, threshold=DARKEST_TONE, unit="of 1", passed=passed, reason=reason)
