"""Compared strokes and their scores stay in the store: memory holds where they are."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np

from brushloop.calibrate.compare.field import KEYS
from brushloop.calibrate.validate.jobs import Press
from brushloop.calibrate.validate.rows import CHUNK, Entry, Rows, Scores
from brushloop.calibrate.validate.store import Store

NAMES = ["ours", "theirs", "another press", "robot writing"]
COLUMNS = [[0, 1, 2, 3], [1, 2, 3]]
"""The second session is not predicted by the first model."""
CELLS = [(13.0, 5.0), (11.0, 0.0), (11.0, 10.0)]


def prepared(store: Store, counts: tuple[int, ...]) -> list[Entry]:
    """Presses of each session in the store, which go through the cells in turn."""
    entries: list[Entry] = []
    for session, count in enumerate(counts):
        for k in range(count):
            cell = CELLS[k % len(CELLS)]
            press = Press(f"{k:06d}", *cell, "", bytes([session, k % 256]), None, False, (), "")
            store.put(f"s{session}:{k}", press.to_body())
            entries.append((session, k, *cell, press.cut))
    return entries


def scored(store: Store, rows: Rows) -> tuple[Scores, np.ndarray]:
    """Random scores in the store as a run leaves them, and the same as one array."""
    rng = np.random.default_rng(0)
    whole = np.full((len(rows), len(NAMES), len(KEYS), 2), np.nan)
    scores = Scores(store, rows, NAMES, COLUMNS)
    for number, (session, _, group) in enumerate(rows.groups()):
        for start in range(0, len(group), CHUNK):
            chunk = group[start : start + CHUNK]
            values = rng.random((len(chunk), len(COLUMNS[session]), len(KEYS), 2))
            store.put(f"{number}-{start}", {"shape": list(values.shape), "values": values.tobytes()})
            scores.add(chunk, f"{number}-{start}")
            whole[np.ix_(chunk, COLUMNS[session])] = values
    return scores, whole


def test_scores_are_read_by_model_and_by_stroke(tmp_path: Path) -> None:
    with Store(tmp_path / "work") as store:
        rows = Rows(store, ["s0", "s1"], prepared(store, (100, 40)))
        scores, expected = scored(store, rows)
        for m, name in enumerate(NAMES):
            assert np.array_equal(scores.of(name), expected[:, m], equal_nan=True)
        for k in (0, 57, 99, 100, 139):
            assert np.array_equal(scores.of_row(k), expected[k], equal_nan=True)


def test_rows_are_in_order_of_capture_and_groups_in_order_of_cells(tmp_path: Path) -> None:
    with Store(tmp_path / "work") as store:
        rows = Rows(store, ["s0", "s1"], prepared(store, (4, 2)))
        assert [(row.session, row.press.stroke_id) for row in rows] == [
            *((0, f"{k:06d}") for k in range(4)),
            *((1, f"{k:06d}") for k in range(2)),
        ]
        assert rows.pixels(5) == bytes([1, 1])
        groups = [(session, cell, group.tolist()) for session, cell, group in rows.groups()]
        first = [(0, (11.0, 0.0), [1]), (0, (11.0, 10.0), [2]), (0, (13.0, 5.0), [0, 3])]
        assert groups == [*first, (1, (11.0, 0.0), [5]), (1, (13.0, 5.0), [4])]
        assert rows.first_of_cells() == {(11.0, 0.0): 1, (11.0, 10.0): 2, (13.0, 5.0): 0}
        assert rows.of_cell((13.0, 5.0)).tolist() == [0, 3, 4]


def test_no_row_is_no_group(tmp_path: Path) -> None:
    with Store(tmp_path / "work") as store:
        rows = Rows(store, ["s0"], [])
        assert (len(rows), list(rows.groups()), rows.first_of_cells()) == (0, [], {})
        assert Scores(store, rows, NAMES, COLUMNS).of("ours").shape == (0, len(KEYS), 2)


def test_a_stroke_takes_some_dozens_of_bytes_in_memory(tmp_path: Path) -> None:
    strokes = 3000
    with Store(tmp_path / "work") as store:
        entries = prepared(store, (strokes,))
        tracemalloc.start()
        try:
            scores = scored(store, Rows(store, ["s0"], iter(entries)))[0]
            assert tracemalloc.get_traced_memory()[0] / strokes < 100
            tracemalloc.reset_peak()
            assert np.isfinite(scores.of("ours")).all()
            assert tracemalloc.get_traced_memory()[1] / strokes < 300
        finally:
            tracemalloc.stop()
