"""The file format `.npz`, a zip archive of `.npy` members, written one member after the other.

Python's `zipfile` keeps about a kilobyte of each member in memory until the end, and compresses in the thread that
writes. Here the directory waits in a temporary file, and a member may come compressed from another thread. Layout of
the records: PKWARE, APPNOTE.TXT 6.3.10, 4.3.7 to 4.3.16 and 4.5.3.
"""

from __future__ import annotations

import io
import shutil
import struct
import tempfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

IN_MEMORY_BYTES = 64 * 1024
ELSEWHERE_32, ELSEWHERE_16 = 0xFFFFFFFF, 0xFFFF
"""Stands in a field of 32 or 16 bits for a value that is too large for it and is given in a longer one."""
LIMIT = ELSEWHERE_32
ZIP64_VERSION, DEFLATED, UTF_8 = 45, 8, 0x800
DATE_1980_01_01 = 0x21
"""Members carry no time, so that equal arrays make equal files."""


@dataclass(frozen=True, slots=True)
class Packed:
    """A member that is compressed already."""

    name: str
    data: bytes
    size: int
    """Before compression."""
    crc: int


def npy_header(dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> bytes:
    """What comes before the values of an array in C order, as numpy writes it."""
    import numpy as np

    buffer = io.BytesIO()
    described = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, described)
    return buffer.getvalue()


def packed_image(name: str, image: NDArray[np.uint8]) -> Packed:
    """A picture as a member. Runs of one value and Huffman's code alone pack pictures quicker and smaller than level 1:
    the noise of a photograph never repeats."""
    header = npy_header(image.dtype, image.shape)
    pixels = image.tobytes()
    packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS, 9, zlib.Z_RLE)
    data = packer.compress(header) + packer.compress(pixels) + packer.flush()
    return Packed(f"{name}.npy", data, len(header) + len(pixels), zlib.crc32(pixels, zlib.crc32(header)))


class NpzFile:
    """Writes an archive into a file that can seek."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._directory = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115
        self._members = 0

    def add(self, member: Packed) -> None:
        """Append a member."""
        begin = self._file.tell()
        self._file.write(_local(member.name, member.crc, len(member.data), member.size))
        self._file.write(member.data)
        self._list(member.name, member.crc, len(member.data), member.size, begin)

    def add_pieces(self, name: str, pieces: Iterable[bytes]) -> None:
        """Append a member that is too large to be held in memory."""
        name, begin, crc, size = f"{name}.npy", self._file.tell(), 0, 0
        self._file.write(_local(name, 0, 0, 0))
        start, packer = self._file.tell(), zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS)
        for piece in pieces:
            self._file.write(packer.compress(piece))
            crc, size = zlib.crc32(piece, crc), size + len(piece)
        self._file.write(packer.flush())
        end = self._file.tell()
        self._file.seek(begin)
        self._file.write(_local(name, crc, end - start, size))
        self._file.seek(end)
        self._list(name, crc, end - start, size, begin)

    def finish(self) -> None:
        """Write the directory of all members."""
        begin = self._file.tell()
        self._directory.seek(0)
        shutil.copyfileobj(self._directory, self._file)
        self._directory.close()
        end = self._file.tell()
        size, count = end - begin, self._members
        if count >= ELSEWHERE_16 or max(size, begin) >= LIMIT:
            version = (ZIP64_VERSION, ZIP64_VERSION)
            self._file.write(struct.pack("<4sQHHLLQQQQ", b"PK\6\6", 44, *version, 0, 0, count, count, size, begin))
            self._file.write(struct.pack("<4sLQL", b"PK\6\7", 0, end, 1))
        few = min(count, ELSEWHERE_16)
        last = (0, 0, few, few, _short(size), _short(begin), 0)
        self._file.write(struct.pack("<4sHHHHLLH", b"PK\5\6", *last))

    def _list(self, name: str, crc: int, packed: int, size: int, begin: int) -> None:
        named = name.encode()
        values = (size, packed, begin)
        large = [value for value in values if value >= LIMIT]
        extra = struct.pack(f"<HH{len(large)}Q", 1, 8 * len(large), *large) if large else b""
        size, packed, begin = (_short(value) for value in values)
        head = (ZIP64_VERSION, ZIP64_VERSION, UTF_8, DEFLATED, 0, DATE_1980_01_01, crc, packed, size)
        lengths = (len(named), len(extra), 0, 0, 0, 0o600 << 16, begin)
        self._directory.write(struct.pack("<4sHHHHHHLLLHHHHHLL", b"PK\1\2", *head, *lengths) + named + extra)
        self._members += 1


def _short(value: int) -> int:
    return value if value < LIMIT else ELSEWHERE_32


def _local(name: str, crc: int, packed: int, size: int) -> bytes:
    """The header in front of a member; its sizes are in the field for large files, whatever they are."""
    named, extra = name.encode(), struct.pack("<HHQQ", 1, 16, size, packed)
    head = (ZIP64_VERSION, UTF_8, DEFLATED, 0, DATE_1980_01_01, crc, ELSEWHERE_32, ELSEWHERE_32, len(named), len(extra))
    return struct.pack("<4sHHHHHLLLHH", b"PK\3\4", *head) + named + extra
