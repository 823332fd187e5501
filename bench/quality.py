"""How well the quality checks distinguish good from failed captures: precision and recall per failure, loopback rig."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from bench.harness import BenchError, Result, percentile
from bench.quality_set import Blank, Sample, draw_set
from brushloop.collect.quality.checks import check_capture, patch_is_blank
from brushloop.collect.quality.verdict import Failure
from brushloop.collect.rig.config_quality import QualityConfig

GOAL = 0.95
"""Precision and recall of each failure."""
FALSE_ALARMS_GOAL = 0.02
CAPTURES = 600
LABELS: tuple[Failure | None, ...] = (None, *Failure)
Called = Failure | None
"""What a capture was, or was called: None is sound."""


@dataclass(slots=True)
class Score:
    """What was, and what it was called."""

    counts: Counter[tuple[Called, Called]] = field(default_factory=Counter[tuple[Called, Called]])
    blanks_seen: Counter[tuple[bool, bool]] = field(default_factory=Counter[tuple[bool, bool]])
    """(blank by the sheet, called blank)."""
    seconds: list[float] = field(default_factory=list[float])

    def of(self, label: Called) -> int:
        """Captures that were this."""
        return sum(self.counts[label, called] for called in LABELS)

    def called(self, label: Called) -> int:
        """Captures that were called this."""
        return sum(self.counts[was, label] for was in LABELS)

    def recall(self, label: Called) -> float:
        """Share of those that were this that were called so. Raises BenchError where there were none."""
        return _share(self.counts[label, label], self.of(label), f"no capture is labelled {_word(label)}")

    def precision(self, label: Called) -> float:
        """Share of those called this that were. Raises BenchError where none was."""
        return _share(self.counts[label, label], self.called(label), f"no capture was called {_word(label)}")

    @property
    def false_alarms(self) -> float:
        """Share of sound captures that were called anything else."""
        return 1.0 - self.recall(None)

    def confused(self, label: Called) -> str:
        """What the others of this were called, in words."""
        wrong = [f"{_word(c)} {self.counts[label, c]}" for c in LABELS if c != label and self.counts[label, c]]
        return ", ".join(wrong) or "nothing else"


def score(samples: Iterable[Sample | Blank], limits: QualityConfig, *, with_previous: bool = True) -> Score:
    """Judge every capture and every blank patch; without `with_previous` the still before a press is withheld."""
    scores = Score()
    for sample in samples:
        if isinstance(sample, Blank):
            seen = patch_is_blank(sample.image, sample.plane, sample.patch, limits=limits)
            scores.blanks_seen[sample.blank, seen.passed] += 1
            continue
        began = time.perf_counter()
        verdict = check_capture(
            sample.image,
            sample.plane,
            sample.patch,
            depth_mm=sample.depth_mm,
            limits=limits,
            previous=sample.before if with_previous else None,
            sheet_mm=sample.sheet_mm,
        )
        scores.seconds.append(time.perf_counter() - began)
        scores.counts[sample.label, verdict.cause.name if verdict.cause else None] += 1
    return scores


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Precision and recall of each failure, false alarms, and seconds per capture, on at least n captures.

    The thresholds were chosen on seeds from 101 on. ratio = the figure over its goal; for false alarms and seconds the
    goal over the figure, with one alarm counted where there was none.
    """
    if n is not None and n < 1:
        raise ValueError(f"n = {n}: at least one capture is needed")
    scores = score(draw_set(seed, CAPTURES if n is None else n), QualityConfig())
    captures, goal = len(scores.seconds), f"goal {GOAL:g}, loopback rig"
    results: list[Result] = []
    for failure in Failure:
        recall, precision = scores.recall(failure), scores.precision(failure)
        where = f"{scores.of(failure)} captures, called {scores.confused(failure)} otherwise"
        results.append(Result(f"quality.{failure}.recall", recall, "of 1", goal, recall / GOAL, captures, seed, where))
        results.append(
            Result(f"quality.{failure}.precision", precision, "of 1", goal, precision / GOAL, captures, seed, where)
        )
    sound, alarms = scores.of(None), scores.false_alarms
    at_least = max(alarms, 1.0 / sound)
    where = f"{sound} sound captures, called {scores.confused(None)} otherwise"
    peer = f"goal {FALSE_ALARMS_GOAL:g} at most, loopback rig"
    results.append(
        Result("quality.false-alarms", alarms, "of 1", peer, FALSE_ALARMS_GOAL / at_least, captures, seed, where)
    )
    slow_s = percentile(scores.seconds, 95.0)
    results.append(
        Result("quality.seconds", slow_s, "s (95 %)", "goal 2 s at most, loopback rig", 2.0 / slow_s, captures, seed)
    )
    return results


def table(scores: Score) -> str:
    """The confusion matrix as a Markdown table: rows are what a capture was, columns what it was called."""
    words = [_word(label) for label in LABELS]
    lines = [
        f"| loopback rig | {' | '.join(words)} | n | recall | precision |",
        f"|---|{'---|' * (len(words) + 3)}",
    ]
    for label in LABELS:
        counts = " | ".join(str(scores.counts[label, called] or "") for called in LABELS)
        figures = f"{scores.of(label)} | {scores.recall(label):.3f} | {scores.precision(label):.3f}"
        lines.append(f"| **{_word(label)}** | {counts} | {figures} |")
    blank, inked = scores.blanks_seen[True, True], scores.blanks_seen[False, False]
    blanks, inkeds = blank + scores.blanks_seen[True, False], inked + scores.blanks_seen[False, True]
    lines += [
        "",
        f"False alarms on sound strokes: {100.0 * scores.false_alarms:.1f} %. "
        f"Blank cells called blank before a press: {blank} of {blanks}; cells with ink refused: {inked} of {inkeds}.",
        f"Seconds per capture: {percentile(scores.seconds, 50.0):.2f} in the middle, "
        f"{percentile(scores.seconds, 95.0):.2f} for 95 %.",
    ]
    return "\n".join(lines)


def _share(part: int, whole: int, otherwise: str) -> float:
    if whole == 0:
        raise BenchError(f"{otherwise}: draw more captures")
    return part / whole


def _word(label: Called) -> str:
    return "sound" if label is None else str(label)


def main(arguments: Sequence[str]) -> None:
    """`python -m bench.quality [CAPTURES [SEED [alone]]]`: the confusion matrix; `alone` omits the earlier still."""
    captures = int(arguments[0]) if arguments else CAPTURES
    seed = int(arguments[1]) if len(arguments) > 1 else 0
    scores = score(draw_set(seed, captures), QualityConfig(), with_previous="alone" not in arguments[2:])
    sys.stdout.write(table(scores) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
