"""Compared strokes in order, and the table of their scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from brushloop.calibrate.compare.place import KEYS
from brushloop.calibrate.scores import Scores
from brushloop.calibrate.validate.jobs import Press
from brushloop.calibrate.validate.rows import Row, Rows
from brushloop.calibrate.validate.store import Store
from brushloop.sessions.records import Condition

CONDITIONS = [Condition(13.0, 5.0), Condition(11.0, 0.0), Condition(11.0, 10.0)]


def prepared(store: Store, counts: tuple[int, ...]) -> list[Row]:
    """Presses of each session, which go through the conditions in turn; their pixels are in the store."""
    rows: list[Row] = []
    for session, count in enumerate(counts):
        for k in range(count):
            press = Press(f"{k:06d}", CONDITIONS[k % len(CONDITIONS)], "", b"", None, False, (), "")
            store.put(f"s{session}:{k}", press.to_body() | {"pixels": bytes([session, k % 256])})
            rows.append(Row(session, f"s{session}:{k}", press))
    return rows


def test_scores_are_read_by_model_and_by_stroke() -> None:
    scores, values = Scores(5, ["ours", "theirs"]), np.random.default_rng(0).random((2, 1, len(KEYS), 2))
    scores.put(np.array([4, 1]), np.array([1]), values)
    assert np.array_equal(scores.of("theirs")[[4, 1]], values[:, 0])
    assert np.isnan(scores.of("ours")).all()
    assert np.isnan(scores.of_stroke(0)).all()
    assert scores.one(1, "theirs", KEYS[2]) == tuple(values[1, 0, 2])


def test_rows_are_in_order_of_capture_and_groups_in_order_of_conditions(tmp_path: Path) -> None:
    with Store(tmp_path / "work") as store:
        rows = Rows(store, prepared(store, (4, 2)))
        assert rows.pixels(5) == bytes([1, 1])
    (shallow, upright, tilted) = CONDITIONS
    groups = [(session, condition, group.tolist()) for session, condition, group in rows.groups]
    first = [(0, upright, [1]), (0, tilted, [2]), (0, shallow, [0, 3])]
    assert groups == [*first, (1, upright, [5]), (1, shallow, [4])]
    assert rows.stratum.tolist() == [2, 0, 1, 2, 4, 3]
    assert rows.first_of_each() == {upright: 1, tilted: 2, shallow: 0}
    assert rows.of_condition(shallow).tolist() == [0, 3, 4]


def test_no_row_is_no_group(tmp_path: Path) -> None:
    with Store(tmp_path / "work") as store:
        rows = Rows(store, [])
    assert (len(rows), rows.groups, rows.first_of_each()) == (0, [], {})
