"""What a Parquet file declares in its footer and page headers, so that memory can be checked before reading.

A few bytes can declare many values. Arrow trusts these headers, and its own parser of a damaged footer can crash the
process, so they are parsed here.

Source: Apache Parquet, parquet.thrift; Apache Thrift, thrift-compact-protocol.md.
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any, NamedTuple

MAGIC = b"PAR1"
LARGEST_FOOTER = 1 << 24  # bytes; files of this program have a few thousand
STRINGS = 6  # parquet.thrift's number of the type of strings
TYPES = (0, 1, 2, 4, 5, STRINGS)  # booleans, integers and floats are the others
# Field numbers of parquet.thrift.
ROWS, GROUPS = 3, 4  # FileMetaData
COLUMNS = 1  # RowGroup
META = 3  # ColumnChunk
TYPE, PATH, VALUES, SIZE, PAGES, DICTIONARY = 1, 3, 5, 7, 9, 11  # ColumnMetaData
UNPACKED, PACKED = 2, 3  # PageHeader
HEADERS = (5, 8)  # PageHeader: the two versions of data page headers
PAGE_VALUES = 1  # DataPageHeader


class Declared(NamedTuple):
    """The contents that a Parquet file declares."""

    rows: int
    values: int  # in all columns
    page_bytes: int  # of all pages, uncompressed
    strings: tuple[str, ...]  # names of columns


def read_declared(path: Path) -> Declared:
    """Return what a Parquet file declares.

    Raises:
        ValueError: the file is not Parquet, or is damaged.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[-4:] != MAGIC or data[:4] != MAGIC:
            raise ValueError("it is no Parquet file, or was cut")
        size = int.from_bytes(data[-8:-4], "little")
        if not 0 < size <= min(len(data) - 12, LARGEST_FOOTER):
            raise ValueError("its footer is damaged")
        try:
            meta = _Reader(data, len(data) - 8 - size).struct()
            chunks = [chunk[META] for group in meta[GROUPS] for chunk in group[COLUMNS]]
            pages = [page for chunk in chunks for page in _pages(data, chunk)]
            declared_values = sum(chunk[VALUES] for chunk in chunks)
            in_pages = sum(page[PAGE_VALUES] for _, header in pages for page in header)
            strings = {chunk[PATH][0].decode() for chunk in chunks if chunk[TYPE] == STRINGS}
            if any(chunk[TYPE] not in TYPES or (chunk[TYPE] == STRINGS and len(chunk[PATH]) > 1) for chunk in chunks):
                raise ValueError("a column has a type that this program does not write")
            values = max(declared_values, in_pages, meta[ROWS] * len({tuple(chunk[PATH]) for chunk in chunks}))
            return Declared(meta[ROWS], values, sum(unpacked for unpacked, _ in pages), tuple(sorted(strings)))
        except (IndexError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError("its footer or the header of a page is damaged") from error


def _pages(data: mmap.mmap, chunk: dict[int, Any]) -> list[tuple[int, list[dict[int, Any]]]]:
    """Return (uncompressed size [bytes], data headers) of each page of a column."""
    # 0: the column has no dictionary
    at = min(place for place in (chunk[PAGES], chunk.get(DICTIONARY, 0), len(data)) if place)
    end = at + chunk[SIZE] if chunk[VALUES] or DICTIONARY in chunk else at
    if not 0 <= at <= end <= len(data):
        raise ValueError("its footer is damaged")
    pages = []
    while at < end:
        reader = _Reader(data, at)
        header = reader.struct()
        if header[UNPACKED] < 0 or header[PACKED] < 0:
            raise ValueError("the header of a page is damaged")
        pages.append((header[UNPACKED], [header[number] for number in HEADERS if number in header]))
        at = reader.at + header[PACKED]
    return pages


class _Reader:
    """Parses values in Thrift's compact protocol; a struct becomes a dict by field number."""

    def __init__(self, data: mmap.mmap, at: int) -> None:
        self._data, self.at = data, at

    def struct(self) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._signed()
            kind = head & 15
            fields[number] = kind == 1 if kind in (1, 2) else self._value(kind)
        return fields

    def _value(self, kind: int) -> Any:
        if kind in (1, 2, 3):  # one byte each, inside a list
            return self._byte()
        if kind in (4, 5, 6):
            return self._signed()
        if kind == 7:
            return self._taken(8)
        if kind == 8:
            return self._taken(self._unsigned())
        if kind in (9, 10):
            head = self._byte()
            size = self._unsigned() if head >> 4 == 15 else head >> 4
            return [self._value(head & 15) for _ in range(size)]
        if kind == 12:
            return self.struct()
        raise ValueError("its footer or the header of a page is damaged")  # a map, which Parquet does not use

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _taken(self, size: int) -> bytes:
        if not 0 <= size <= len(self._data) - self.at:
            raise IndexError
        self.at += size
        return self._data[self.at - size : self.at]

    def _unsigned(self) -> int:
        value, shift = 0, 0
        while (byte := self._byte()) & 128 and shift < 70:
            value, shift = value | (byte & 127) << shift, shift + 7
        return value | byte << shift

    def _signed(self) -> int:
        value = self._unsigned()
        return value >> 1 ^ -(value & 1)
