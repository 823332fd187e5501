"""Messages of one finished step, put together from every file that still holds some of them.

A message is identified by its topic and its number within the step. In the step's own file that is its number in the
file; in the merged file, where the steps follow each other, the messages of the earlier steps are subtracted. Chunks
that cannot be read are counted by their index; those behind a chunk without an index are counted from the end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from mcap.records import Message
from pydantic import ValidationError

from brushloop.sessions.journal.codec import Line
from brushloop.sessions.mcap_file import Part, Record, Scan
from brushloop.sessions.records import BEGIN_NOTE, DONE_NOTE, StepEvent, Stroke, Topic

Place = tuple[str, int]
"""Topic, and number within the step."""


@dataclass(frozen=True, slots=True)
class Source:
    """File that may hold messages of the step, and where they are in it."""

    found: Scan
    totals: Counter[str]
    """Messages by topic in the whole file, as originally written."""
    before: Counter[str]
    """Messages by topic that precede the step."""


def identity_of(found: Scan) -> tuple[str, int] | None:
    """Key and attempt of the step recorded in a file, from its content, whatever its name."""
    for values in (found.notes.get(BEGIN_NOTE, {}).get("line"), found.notes.get(DONE_NOTE)):
        match values:
            case {"key": str(key), "attempt": int(attempt)}:
                return key, attempt
            case _:
                pass
    for _schema, channel, message in found.messages():
        if channel.topic == Topic.STEP:
            event = parsed(StepEvent, message)
            return None if event is None else (event.key, event.attempt)
    return None


def united(line: Line, sources: Iterable[Source]) -> list[Record]:
    """Messages that remain of the step with this `done` line, in the order in which they were written."""
    counts = Counter[str](line["counts"])
    records: dict[Place, Record] = {}
    after: dict[Place | None, Place | None] = {None: None}
    """Next place after each place; None is the beginning."""
    for source in sources:
        part = dict(_of_step(source, counts))
        if not _agrees(part, records, line):
            continue
        last: Place | None = None
        for place in part:
            if place not in records:
                after[place], after[last] = after[last], place
            last = place
        records = part | records
        if len(records) == counts.total():
            break
    ordered: list[Record] = []
    place = after[None]
    while place is not None:
        ordered.append(records[place])
        place = after[place]
    return ordered


def _agrees(part: dict[Place, Record], records: dict[Place, Record], line: Line) -> bool:
    """Whether these messages belong to this step and equal those that another file holds in the same place."""
    for place, (_schema, channel, message) in part.items():
        if place in records and records[place][2].data != message.data:
            return False
        if channel.topic == Topic.STEP:
            event = parsed(StepEvent, message)
            if event is None or (event.key, event.attempt) != (line["key"], line.get("attempt", 1)):
                return False
    return True


def _of_step(source: Source, counts: Counter[str]) -> Iterator[tuple[Place, Record]]:
    """Messages of the step in a file, each with its place."""
    for part, first in placed(source.found, source.totals):
        numbers = first.copy()
        wanted = {topic: range(source.before[topic], source.before[topic] + count) for topic, count in counts.items()}
        inside = part.counts or Counter[str]()
        if not any(r.start < first[t] + inside[t] and first[t] < r.stop for t, r in wanted.items() if inside[t]):
            continue
        for record in source.found.messages([part]):
            topic = record[1].topic
            if numbers[topic] in wanted.get(topic, ()):
                yield (topic, numbers[topic] - source.before[topic]), record
            numbers[topic] += 1


def placed(found: Scan, totals: Counter[str]) -> list[tuple[Part, Counter[str]]]:
    """Sound chunks of a file, each with the number, by topic, of its first message; `totals` are the file's.

    A chunk between two others whose messages cannot be counted is left out.
    """
    parts = list(found.parts)
    lost = [at for at, part in enumerate(parts) if part.counts is None]
    if not found.complete:
        lost.append(len(parts))
    known = sum((part.counts for part in parts if part.counts is not None), Counter[str]())
    if known - totals or (not lost and totals - known):
        return []  # not the file that was counted
    first, last = (lost[0], lost[-1]) if lost else (len(parts), -1)
    chunks: list[tuple[Part, Counter[str]]] = []
    number = Counter[str]()
    for part in parts[:first]:
        chunks.append((part, number.copy()))
        number.update(part.counts or {})
    behind: list[tuple[Part, Counter[str]]] = []
    number = totals.copy()
    for part in reversed(parts[max(first, last + 1) :]):
        number.subtract(part.counts or {})
        behind.append((part, number.copy()))
    return [(part, number) for part, number in [*chunks, *reversed(behind)] if part.sound]


_E = TypeVar("_E", Stroke, StepEvent)


def parsed(kind: type[_E], message: Message) -> _E | None:
    """The event in a message; None where it does not fit its schema."""
    try:
        return kind.model_validate_json(message.data)
    except ValidationError:
        return None
