"""MCAP (https://mcap.dev/spec) as far as takes need it: topics of messages with a time, in chunks.

The records come from the `mcap` package, messages are written and read here. A take has about 1800 of them a
second, and `mcap.writer.Writer` spends 5 µs on each, next to the control loop, where this takes 2 µs; reading
goes by whole columns of messages instead of one by one.
"""

from __future__ import annotations

import functools
import io
import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import lz4.frame
import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Header as FileHeader
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC

from controller.types import Array

CHUNK_SIZE = 1024 * 1024  # [bytes] before compression
RECORD_LIMIT = 256 * 1024 * 1024  # [bytes] a longer record is a damaged length

_RECORD_HEAD = 9  # [bytes] opcode, length
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_INDEX_HEAD = struct.Struct("<BQHI")  # opcode, length, channel, bytes of (log time, offset) pairs
_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, starts of summary and of its offsets, CRC, magic
_UNREADABLE = (McapError, struct.error, ValueError, RuntimeError)  # RuntimeError: of lz4


class EpisodeError(ValueError):
    """A file that cannot be read as a take, and what can be done about it."""


class McapWriter:
    """Writes messages into lz4 chunks. A chunk is in `file` after `flush`, the index only after `finish`."""

    def __init__(self, file: IO[bytes], library: str) -> None:
        self._file = file
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: Counter[int] = Counter()  # messages of each channel
        self._records = bytearray()  # of the chunk to come
        self._indexes: dict[int, array[int]] = {}  # channel -> its log times [ns] and offsets, in turn
        self._file.write(MAGIC)
        self._put(FileHeader(profile="", library=library))

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        offset = self._file.tell()
        length = self._put(Metadata(name=name, metadata=entries))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def has_topic(self, topic: str) -> bool:
        return topic in self._channels

    def add_topic(self, topic: str, schema: str, descriptors: bytes) -> None:
        """Register a topic of protobuf messages called `schema`, which a FileDescriptorSet describes."""
        if schema not in self._schemas:
            self._schemas[schema] = Schema(
                id=len(self._schemas) + 1, name=schema, encoding="protobuf", data=descriptors
            )
            self._put(self._schemas[schema])
        self._channels[topic] = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="protobuf",
            metadata={},
            schema_id=self._schemas[schema].id,
        )
        self._put(self._channels[topic])

    def add(self, topic: str, wire: bytes, log_ns: int, publish_ns: int) -> None:
        """Add a message of a topic that is registered."""
        channel = self._channels[topic].id
        if channel not in self._indexes:
            self._indexes[channel] = array("Q")
        self._indexes[channel].extend((log_ns, len(self._records)))
        length = _MESSAGE_HEAD.size - _RECORD_HEAD + len(wire)
        self._records += _MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel, 0, log_ns, publish_ns)
        self._records += wire
        if len(self._records) > CHUNK_SIZE:
            self._put_chunk()

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._put_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write the index. The file stays open, and not all of it need be on the disk."""
        self._put_chunk()
        self._put(DataEnd(data_section_crc=0))
        start = self._file.tell()
        summary = RecordBuilder()
        for record in (
            *self._schemas.values(),
            *self._channels.values(),
            self._statistics(),
            *self._chunks,
            *self._metadata,
        ):
            record.write(summary)
        data = bytes(summary.end())  # type: ignore[no-untyped-call]
        crc = zlib.crc32(data + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0))  # as the spec defines it
        self._file.write(data)
        self._put(Footer(summary_start=start, summary_offset_start=0, summary_crc=crc))
        self._file.write(MAGIC)

    def _put_chunk(self) -> None:
        if not self._records:
            return
        data = lz4.frame.compress(self._records)
        times = [time for index in self._indexes.values() for time in index[::2]]
        start, end, size = min(times), max(times), len(self._records)
        chunk = Chunk(
            compression="lz4",
            data=data,
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(self._records),
            uncompressed_size=size,
        )
        chunk_offset = self._file.tell()
        chunk_length = self._put(chunk)
        offsets = {channel: self._put_index(channel, index) for channel, index in self._indexes.items()}
        self._chunks.append(
            ChunkIndex(
                chunk_start_offset=chunk_offset,
                chunk_length=chunk_length,
                compression="lz4",
                compressed_size=len(data),
                uncompressed_size=size,
                message_start_time=start,
                message_end_time=end,
                message_index_offsets=offsets,
                message_index_length=self._file.tell() - chunk_offset - chunk_length,
            )
        )
        self._records.clear()
        self._indexes.clear()

    def _put_index(self, channel: int, index: array[int]) -> int:
        """Write a Message Index record; return where it is."""
        offset = self._file.tell()
        entries = index.tobytes()
        self._file.write(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)))
        self._file.write(entries)
        self._counts[channel] += len(index) // 2
        return offset

    def _put(self, record: McapRecord) -> int:
        """Write a record; return its length [bytes]."""
        builder = RecordBuilder()
        record.write(builder)
        return self._file.write(builder.end())  # type: ignore[no-untyped-call]

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


class McapFile:
    """A finished file, read-only, for several threads. Messages of a topic are counted in file order."""

    def __init__(self, path: Path) -> None:
        """Raise `EpisodeError` on a file that is empty, torn, or no MCAP."""
        self.path = path
        self._file = path.open("rb")
        try:
            summary = _summary_of(path, self._file)
        except BaseException:
            self._file.close()
            raise
        self._chunks = summary.chunk_indexes
        self._metadata = summary.metadata_indexes
        self._channels = {channel.topic: channel.id for channel in summary.channels.values()}
        self._indexes: dict[str, Array] = {}
        self._recent_chunk = functools.lru_cache(maxsize=32)(self._chunk)  # at most 32 MB

    def close(self) -> None:
        self._file.close()

    @property
    def topics(self) -> tuple[str, ...]:
        return tuple(self._channels)

    def metadata(self, name: str) -> dict[str, str] | None:
        for index in self._metadata:
            if index.name == name:
                record = self._read(index.offset, index.length)[_RECORD_HEAD:]
                entries: dict[str, str] = Metadata.read(ReadDataStream(io.BytesIO(record))).metadata
                return entries
        return None

    def log_times(self, topic: str) -> Array:
        """(n,) int64 [ns] of the messages of a topic; empty for one that does not exist."""
        return self._index(topic)[:, 0]

    def message(self, topic: str, number: int) -> bytes:
        _, chunk, start = self._index(topic)[number].tolist()
        records = self._recent_chunk(chunk)
        length = int(records[start + 1 : start + _RECORD_HEAD].view("<u8")[0])
        return records[start + _MESSAGE_HEAD.size : start + _RECORD_HEAD + length].tobytes()

    def messages(self, topic: str) -> Iterator[bytes]:
        return (self.message(topic, number) for number in range(len(self._index(topic))))

    def heads(self, sizes: Mapping[str, int]) -> dict[str, Array]:
        """The first `size` bytes of every message of some topics, (n, size) uint8."""
        parts = {topic: [np.empty((0, size), np.uint8)] for topic, size in sizes.items()}
        indexes = {topic: self._index(topic) for topic in sizes}
        for number in range(len(self._chunks)):
            records = self._chunk(number)
            for topic, size in sizes.items():
                first, last = np.searchsorted(indexes[topic][:, 1], (number, number + 1))
                if first < last:
                    starts = indexes[topic][first:last, 2] + _MESSAGE_HEAD.size
                    parts[topic].append(np.lib.stride_tricks.sliding_window_view(records, size)[starts])
        return {topic: np.concatenate(part) for topic, part in parts.items()}

    def _index(self, topic: str) -> Array:
        """(n, 3) int64 of the messages of a topic: log time [ns], chunk, offset in the chunk."""
        if topic not in self._indexes:
            parts = [np.empty((0, 3), np.int64)]
            channel = self._channels.get(topic, -1)
            for number, chunk in enumerate(self._chunks):
                if channel in chunk.message_index_offsets:
                    entries = self._entries(chunk.message_index_offsets[channel])
                    parts.append(np.insert(entries, 1, number, axis=1))
            self._indexes[topic] = np.concatenate(parts)
        return self._indexes[topic]

    def _entries(self, offset: int) -> Array:
        """(n, 2) int64 of a Message Index record: log time [ns], offset in the chunk."""
        *_, size = _INDEX_HEAD.unpack(self._read(offset, _INDEX_HEAD.size))
        return np.frombuffer(self._read(offset + _INDEX_HEAD.size, size), "<i8").reshape(-1, 2)

    def _chunk(self, number: int) -> Array:
        """(size,) uint8: the records of a chunk."""
        index = self._chunks[number]
        record = self._read(index.chunk_start_offset, index.chunk_length)[_RECORD_HEAD:]
        try:
            stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(io.BytesIO(record))))
        except _UNREADABLE as error:
            raise EpisodeError(f"{self.path} is damaged in its chunk {number}: {error}.") from error
        return np.frombuffer(stream.read(size), np.uint8)

    def _read(self, offset: int, size: int) -> bytes:
        return os.pread(self._file.fileno(), size, offset)


def _summary_of(path: Path, file: IO[bytes]) -> Any:
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise EpisodeError(f"{path} is empty.")
    if file.read(len(MAGIC)) != MAGIC:
        raise EpisodeError(f"{path} is not an MCAP file.")
    if size < 2 * len(MAGIC) or os.pread(file.fileno(), len(MAGIC), size - len(MAGIC)) != MAGIC:
        raise EpisodeError(f"{path} is torn: its end is missing. `studio recover` brings back what it holds.")
    file.seek(0)
    try:
        summary = make_reader(file).get_summary()
    except _UNREADABLE as error:
        raise EpisodeError(f"{path} is damaged: {error}.") from error
    if summary is None or not summary.chunk_indexes:
        raise EpisodeError(f"{path} is an MCAP file, but not a take of Studio: it has no chunks.")
    return summary


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    """The metadata records of a finished file by name, found without reading its index.

    Empty for whatever is no finished file; `McapFile` says why.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        tail = os.pread(file.fileno(), _FOOTER.size, max(0, size - _FOOTER.size))
        if len(tail) < _FOOTER.size or file.read(len(MAGIC)) != MAGIC:
            return {}
        opcode, _, start, _, _, magic = _FOOTER.unpack(tail)
        if opcode != Opcode.FOOTER or magic != MAGIC or not 0 < start < size:
            return {}
        summary = os.pread(file.fileno(), size - start - _FOOTER.size, start)
        found = {}
        for index in _metadata_indexes(summary):
            record = os.pread(file.fileno(), index.length, index.offset)[_RECORD_HEAD:]
            found[index.name] = Metadata.read(ReadDataStream(io.BytesIO(record))).metadata
        return found


def _metadata_indexes(summary: bytes) -> Iterator[MetadataIndex]:
    at = 0
    while at + _RECORD_HEAD <= len(summary):
        opcode, length = struct.unpack_from("<BQ", summary, at)
        at += _RECORD_HEAD
        if opcode == Opcode.METADATA_INDEX:
            yield MetadataIndex.read(ReadDataStream(io.BytesIO(summary[at : at + length])))
        at += length


def read_until_torn(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records of a file, those in chunks too, up to the first that cannot be read."""
    try:
        yield from StreamReader(file, validate_crcs=True, record_size_limit=RECORD_LIMIT).records
    except _UNREADABLE:
        return
