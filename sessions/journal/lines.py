"""Reading the lines of a journal: which can be trusted, and what is wrong with each of the others.

A chained line is trusted if the next line holds its hash. Older journals have lines without a chain, and the oldest
have no CRC either; these are read as well, and the first chained line holds the hash of all lines before it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from brushloop.sessions.disk import read_bounded
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError
from brushloop.sessions.journal.codec import BadLine, Entry, Line, decode_line, digest, has_crc, lines_within
from brushloop.sessions.names import check_file

MAX_JOURNAL_BYTES = 256 * 1024 * 1024
"""Several times the journal of 20,000 strokes."""
MAX_STRANGE_BYTES = 30
"""Most bytes in which a rebuilt line may differ from the damaged one: its time (19), its CRC (8), and the damage."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Problem with one line."""

    number: int
    """Number of the line in the file as it is, from 1."""
    what: str

    def __str__(self) -> str:
        """Text such as `line 5 does not match its CRC`."""
        return f"line {self.number} {self.what}"


@dataclass(slots=True)
class Reading:
    """Trusted lines of a journal, and what is wrong with the rest."""

    entries: list[Entry] = field(default_factory=list[Entry])
    """Lines that can be trusted, in the order in which they were written."""
    faults: list[Fault] = field(default_factory=list[Fault])
    """In the order of the file; empty for a journal without damage."""
    damaged: list[tuple[int, bytes]] = field(default_factory=list[tuple[int, bytes]])
    """Number and bytes of lines that can no longer be trusted."""
    gaps: int = 0
    """Number of missing lines."""
    torn: bytes = b""
    """Last line, cut off by a crash: harmless, the next process sets it aside."""

    @property
    def unchained(self) -> int:
        """Number of lines at the beginning that were written without a chain."""
        return sum(entry.chain is None for entry in self.entries)

    def fault(self, number: int, what: str) -> None:
        """Note a problem."""
        self.faults.append(Fault(number, what))


def read_lines(path: Path) -> Iterator[Line]:
    """Complete lines, without a torn last one; any other damage raises `SessionDamaged`."""
    reading = read(read_journal(path))
    if reading.faults:
        raise SessionDamaged(path, str(reading.faults[0]))
    return iter([entry.line for entry in reading.entries])


def read_journal(path: Path) -> bytes:
    """Bytes of a journal. Raises `SessionError`, `SessionDamaged` if it is too large, and `InputError` for a link."""
    if check_file(path) and path.stat().st_size > MAX_JOURNAL_BYTES:
        raise SessionDamaged(path, f"is larger than {MAX_JOURNAL_BYTES} bytes")
    try:
        return read_bounded(path, MAX_JOURNAL_BYTES)
    except InputError as error:
        raise SessionError(path, error.what) from None


def read(data: bytes, session: str = "") -> Reading:
    """Read whatever can still be trusted in the bytes of a journal.

    Lines of another session than `session` are never trusted; without it, those of the session with most lines are.
    """
    *pieces, tail = data.split(b"\n")
    reading = Reading()
    entries = _decoded(reading, pieces, tail)
    first = next((entry for entry in entries if entry.chain is not None), None)
    ours = first is not None and session in ("", _session_of([first]))
    if first is None or (ours and _is_perfect(entries, first, data)):
        reading.entries = entries
    else:
        _link(reading, entries, data, session or _session_of(entries))
        reading.faults.sort(key=lambda fault: fault.number)
    return reading


def accounts_for(damaged: bytes, rebuilt: bytes) -> bool:
    """Whether a damaged line (cut short, or with wrong bytes) is what is left of `rebuilt`, which has no chain."""
    body = rebuilt[: rebuilt.rindex(b',"crc":"')]
    if len(damaged) < len(body) // 2:
        return False
    strange = sum(a != b for a, b in zip(damaged, body, strict=False))
    return strange <= min(MAX_STRANGE_BYTES, len(damaged) // 2)


def _decoded(reading: Reading, pieces: list[bytes], tail: bytes) -> list[Entry]:
    """Lines that match their CRC, even if the newline between two of them is damaged."""
    chained_at = next((at for at, raw in enumerate(pieces) if _is_chained(raw)), len(pieces))
    protected = any(has_crc(raw) for raw in pieces[:chained_at])
    entries: list[Entry] = []
    for number, raw in enumerate(pieces, start=1):
        crc = protected or number > chained_at
        try:
            entries.append(decode_line(raw, number, protected=crc))
        except BadLine as error:
            found, left = lines_within(raw, number) if crc else ([], [raw])
            reading.fault(number, "has a damaged end" if found and not left else str(error))
            entries += found
            reading.damaged += [(number, span) for span in left]
    if tail:
        found, left = lines_within(tail, len(pieces) + 1)
        entries += found
        if not found:
            reading.torn = tail
        elif left or tail != found[-1].raw:
            reading.fault(len(pieces) + 1, "has a damaged end")
            reading.damaged += [(len(pieces) + 1, span) for span in left]
    return entries


def _is_chained(raw: bytes) -> bool:
    try:
        return decode_line(raw, 0, protected=True).chain is not None
    except BadLine:
        return False


def _is_perfect(entries: list[Entry], first: Entry, data: bytes) -> bool:
    start = entries.index(first)
    prev = digest(_before(first, data))
    for number, entry in enumerate(entries[start:], start=start + 1):
        chain = entry.chain
        if chain is None or first.chain is None or entry.number != number:
            return False
        if (chain.seq, chain.session, chain.prev) != (number, first.chain.session, prev):
            return False
        prev = digest(entry.raw)
    return True


def _before(entry: Entry, data: bytes) -> bytes:
    """All bytes before a line."""
    at = 0
    for _ in range(entry.number - 1):
        at = data.index(b"\n", at) + 1
    return data[:at]


def _session_of(entries: list[Entry]) -> str:
    """Session that most lines name."""
    sessions = Counter(entry.chain.session for entry in entries if entry.chain is not None)
    return sessions.most_common(1)[0][0]


def _link(reading: Reading, entries: list[Entry], data: bytes, session: str) -> None:
    """Find lines of `session` that break its chain: doubled, displaced, changed and missing ones; and foreign lines."""
    foreign: dict[str, list[int]] = {}
    before: list[Entry] = []
    by_seq: dict[int, list[Entry]] = {}
    for entry in entries:
        if entry.chain is None:
            if not by_seq:
                before.append(entry)
            else:
                reading.fault(entry.number, "has no chain: another program inserted it")
        elif entry.chain.session != session:
            foreign.setdefault(entry.chain.session, []).append(entry.number)
        else:
            by_seq.setdefault(entry.chain.seq, []).append(entry)
    for other, numbers in foreign.items():
        more = f", as are {len(numbers) - 1} more" if len(numbers) > 1 else ""
        reading.fault(numbers[0], f"is of another session, {other[:100]!r}{more}")
    if not by_seq:
        reading.entries = before
        return
    held = _vouched(reading, by_seq)
    _misplaced(reading, held)
    first = held[0]
    assert first.chain is not None
    if first.chain.seq == len(before) + 1 and first.chain.prev != digest(_before(first, data)) and before:
        reading.fault(first.number, "does not follow from the lines before it: one of them was changed")
    _missing(reading, held, len(before))
    reading.entries = before + held


def _vouched(reading: Reading, by_seq: dict[int, list[Entry]]) -> list[Entry]:
    """Choose for each sequence number the entry whose hash the next line holds; return them in order."""
    held: list[Entry] = []
    for seq in sorted(by_seq, reverse=True):
        after = held[-1] if held else None
        chain = after.chain if after is not None else None
        prev = chain.prev if chain is not None and chain.seq == seq + 1 else None
        one, *others = sorted(by_seq[seq], key=lambda entry: digest(entry.raw) != prev)
        for other in others:
            same = other.raw == one.raw
            reading.fault(other.number, f"{'stands twice: it is' if same else 'stands in the place of'} line {seq}")
        if after is not None and prev is not None and digest(one.raw) != prev:
            reading.fault(one.number, f"was changed after it was written: line {after.number} does not follow from it")
            reading.damaged.append((one.number, one.raw))
        else:
            held.append(one)
    return held[::-1]


def _misplaced(reading: Reading, held: list[Entry]) -> None:
    """Report lines outside the longest run that is in order."""
    ends: list[int] = []
    """Index of the last entry of the best run of each length."""
    before: list[int | None] = []
    for index, entry in enumerate(held):
        at = bisect_right(ends, entry.number, key=lambda end: held[end].number)
        before.append(ends[at - 1] if at else None)
        ends[at : at + 1] = [index]
    in_order: set[int] = set()
    index = ends[-1] if ends else None
    while index is not None:
        in_order.add(index)
        index = before[index]
    for index, entry in enumerate(held):
        if index not in in_order and entry.chain is not None:
            reading.fault(entry.number, f"is out of place: it was written as line {entry.chain.seq}")


def _missing(reading: Reading, held: list[Entry], before: int) -> None:
    """Report sequence numbers that no line has, except those of lines that cannot be trusted."""
    damaged = {number for number, _ in reading.damaged}
    known, at = before, 0
    for entry in held:
        seq = known + 1 if entry.chain is None else entry.chain.seq
        gone = seq - known - 1 - sum(at < number < entry.number for number in damaged)
        if gone > 0:
            lines = "a line that is" if gone == 1 else f"{gone} lines that are"
            reading.fault(entry.number, f"comes after {lines} missing")
            reading.gaps += gone
        known, at = seq, max(at, entry.number)
