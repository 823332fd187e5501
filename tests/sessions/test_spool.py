"""A sequence that waits in a temporary file reads as a list does."""

import json
from itertools import islice

from brushloop.sessions.spool import IN_MEMORY_BYTES, Spool


def test_items_beyond_memory_come_back_in_order_and_again() -> None:
    items = [f"stroke {k} · 永" * 40 for k in range(1000)]
    spool: Spool[str] = Spool(json.dumps, json.loads, items[:-1])
    spool.append(items[-1])
    assert sum(map(len, items)) > 4 * IN_MEMORY_BYTES
    assert len(spool) == 1000
    assert list(spool) == list(spool) == items


def test_two_walks_at_once_do_not_disturb_each_other() -> None:
    spool: Spool[int] = Spool(json.dumps, json.loads, range(100_000))
    first, second = iter(spool), iter(spool)
    assert list(islice(first, 90_000))[-1] == 89_999
    assert list(islice(second, 3)) == [0, 1, 2]
    assert next(first) == 90_000


def test_a_walk_that_is_broken_off_does_not_move_where_items_are_added():
    spool: Spool[int] = Spool(json.dumps, json.loads, range(100_000))
    assert next(iter(spool)) == 0
    spool.append(100_000)
    assert list(spool) == list(range(100_001))
