"""What `brushloop repress` and `brushloop write` leave behind, without a rig: small records of a few scores."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from brushloop.calibrate.compare import KEYS, Tone
from brushloop.calibrate.loop import AGAIN, ANOTHER, SIMULATED, LoopRecord, statistics_of
from brushloop.calibrate.presses import Press
from brushloop.calibrate.scores import Scores
from brushloop.calibrate.stroke import Measured
from brushloop.calibrate.writing import Figure
from brushloop.calibrate.writing.compare import KEYS as WRITTEN_KEYS
from brushloop.calibrate.writing.compare import PAIRS, PLANNED, Character, Table3Row, WritingComparison, WrittenRecord
from brushloop.sessions.records import Source, Stroke

LEVELS = {AGAIN: 0.94, ANOTHER: 0.95, SIMULATED: 0.9}


def pair_scores(step: float = 0.001) -> Scores:
    """Six presses of three conditions, each pressed again: .94 like its original, another press .95."""
    blank, sizes = np.zeros((len(KEYS), 128, 128), np.uint8), Measured(1.0, 1.0, 1.0, 1.0, 1.0)
    presses: list[Press] = []
    for k in range(6):
        stroke = Stroke(stroke_id=f"{k:03d}", kind="press", still=k, depth_mm=11.0 + k // 2, tilt_deg=0.0)
        presses.append(Press("grid", "", stroke, blank, np.zeros((128, 128), np.float32), (0.0, 0.0), sizes, False))
    scores = Scores(presses, tuple(LEVELS))
    levels = np.array(list(LEVELS.values())) + step * np.arange(6)[:, None]
    scores.values[:] = np.stack([levels, levels - 0.1], axis=-1)[:, :, None]
    return scores


def loop_record(original: str, original_sha256: str, source: Source = Source.LOOPBACK, **changes: Any) -> LoopRecord:
    """A sealed loop of that session; `changes` are made before it is sealed."""
    scores = pair_scores()
    record = LoopRecord(
        source=source,
        original=original,
        original_sha256=original_sha256,
        again=f"{original}-replay",
        again_sha256="0" * 64,
        model="CCD-BSM fitted",
        in_sample=True,
        mm_per_px=0.3,
        pairs=6,
        goal_points=1.0,
        stats=tuple(statistics_of(scores)),
        refused=(),
        software="brushloop test",
        command="brushloop repress compare",
    )
    return record.model_copy(update=changes).sealed()


def table_of(character: str = "字", reference: str = "a font") -> tuple[Table3Row, ...]:
    """Table 3 of one character, written twice: CSIM .8 and .9, where paper counts .99."""
    ink = np.zeros((128, 128), np.float32)
    figure = Figure(name=character, source=reference)
    written = Character(figure, {f"x-r{k}": dict.fromkeys(Tone, ink) for k in range(2)})
    twice = np.array([[0.8, 0.7], [0.9, 0.8]])
    # Takes the place of what would be computed from the images.
    written.__dict__["scores"] = {
        (pair, key): twice[: 1 if pair == PLANNED else 2] for key, pair in itertools.product(WRITTEN_KEYS, PAIRS)
    }
    return WritingComparison(None, None, [written]).table_3


def written_record(source: Source = Source.LOOPBACK, **changes: Any) -> WrittenRecord:
    """A sealed record of one character; `changes` are made before it is sealed."""
    record = WrittenRecord(
        source=source,
        session="write-01",
        recording_sha256="1" * 64,
        brush="",
        model="CCD-BSM",
        cell_mm=70.0,
        table_3=table_of(),
        refused=(),
        figure_13_sha256="2" * 64,
        software="brushloop test",
        command="brushloop write compare",
    )
    return record.model_copy(update=changes).sealed()
