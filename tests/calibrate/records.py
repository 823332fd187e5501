"""What `brushloop loop` and `brushloop write` leave behind, without a rig: small records of a few scores."""

from __future__ import annotations

import itertools
from typing import Any

from brushloop.calibrate.compare.place import KEYS
from brushloop.calibrate.loop.scores import AGAIN, ANOTHER, SIMULATED, LoopRecord, PairScore, table_1, verdicts
from brushloop.calibrate.writing.scores import KEYS as WRITTEN_KEYS
from brushloop.calibrate.writing.scores import PAIRS, PLANNED, Table3Row, WrittenRecord, WrittenScore, table_3
from brushloop.sessions.records import Condition, Source

LEVELS = {AGAIN: 0.94, ANOTHER: 0.95, SIMULATED: 0.9}


def pair_scores(step: float = 0.001) -> list[PairScore]:
    """Six presses of three cells, each pressed again: .94 like its original, another press .95."""
    made: list[PairScore] = []
    for number, ((alignment, tone), what) in itertools.product(range(6), itertools.product(KEYS, LEVELS)):
        csim = LEVELS[what] + number * step
        condition = Condition(11.0 + number // 2, 0.0)
        made.append(PairScore(f"{number:03d}", f"{number:03d}~1", condition, what, alignment, tone, csim, csim - 0.1))
    return made


def loop_record(original: str, original_sha256: str, source: Source = Source.LOOPBACK, **changes: Any) -> LoopRecord:
    """A sealed loop of that session; `changes` are made before it is sealed."""
    again = f"{original}-replay"
    scores = pair_scores()
    record = LoopRecord(
        source=source,
        original=original,
        original_sha256=original_sha256,
        again=again,
        again_sha256="0" * 64,
        model="CCD-BSM fitted",
        in_sample=True,
        mm_per_px=0.3,
        pairs=6,
        goal_points=1.0,
        table_1=tuple(table_1(scores, source=source, original=original, again=again, model="CCD-BSM fitted")),
        verdicts=tuple(verdicts(scores)),
        refused=(),
        software="brushloop test",
        command="brushloop loop compare",
    )
    return record.model_copy(update=changes).sealed()


def table_of(character: str = "字", source: Source = Source.LOOPBACK, **named: str) -> list[Table3Row]:
    """Table 3 of one character, written twice: CSIM .8 and .9, where paper counts .99."""
    scores = [
        WrittenScore(character, f"x-r{k}", pair, alignment, tone, polarity, csim, csim - 0.1)
        for k, csim in enumerate((0.8, 0.9))
        for (alignment, tone, polarity), pair in itertools.product(WRITTEN_KEYS, PAIRS)
        if k == 0 or pair != PLANNED
    ]
    references = {character: named.get("reference", "a font")}
    session = named.get("session", "write-01")
    return table_3(
        scores, source=source, session_id=session, model=named.get("model", "CCD-BSM"), references=references
    )


def written_record(rows: tuple[Table3Row, ...], **changes: Any) -> WrittenRecord:
    """A sealed record of those rows; `changes` are made before it is sealed."""
    record = WrittenRecord(
        source=rows[0].source,
        session=rows[0].session_id,
        recording_sha256="1" * 64,
        brush="",
        model=rows[0].model,
        cell_mm=70.0,
        table_3=rows,
        refused=(),
        figure_13_sha256="2" * 64,
        software="brushloop test",
        command="brushloop write compare",
    )
    return record.model_copy(update=changes).sealed()
