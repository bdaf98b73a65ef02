"""MCAP files: a crash-safe writer that gives the same bytes for the same messages, the live recorder, a repair.

    python -m fusiond_adapters.mcap CUT.mcap WHOLE.mcap

copies the intact part of a file that was cut off (power failure, full disk) into a file with an index. Needs the extra
`mcap`.
"""

from __future__ import annotations

import argparse
import re
import struct
import sys
from collections.abc import Callable, Sequence
from io import FileIO
from pathlib import Path
from threading import Event
from types import TracebackType

import msgspec

from fusiond import __version__
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.messages.info import config_table
from fusiond.ports.outputs import POLL_S, LiveOutput, Outbox, OutputContext, OutputLost
from fusiond.units import SECOND
from fusiond_adapters.foxglove.converter import SHOWN, Channel, Converter, Record, channels
from fusiond_adapters.host.bounded_folder import FLUSH_S, MEGABYTE, BoundedFolder

try:
    from mcap import records
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader
    from mcap.writer import Writer
    from zstandard import ZstdError
except ModuleNotFoundError as missing:
    raise ConfigError("MCAP files need the extra mcap: pip install 'fusiond[mcap]'") from missing

CHUNK_BYTES = 1 << 20  # largest chunk
LIBRARY = f"fusiond {__version__}"
KIND = "fusion.mcap"
MAX_WAITING = 4096  # messages between the estimator and the disk


class McapFile:
    """One file. A chunk ends with each second of publish time and is written at once: a crash costs the last second. A
    context manager: its end writes the index. Raises OSError.
    """

    def __init__(self, path: Path, config: Config) -> None:
        self.written = 0  # records written
        self.waiting = 0  # records of the present chunk
        self.unknown = 0  # records of unknown topics, which are left out
        self._path, self._out = path, _Out(path)
        self._writer = Writer(self._out, chunk_size=CHUNK_BYTES)
        self._writer.start(library=LIBRARY)
        self._writer.add_metadata("fusiond", _metadata(config))
        self._channels = {channel.topic: _registered(self._writer, channel) for channel in channels(config)}
        self._second: int | None = None

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._out.written

    def add(self, record: Record) -> None:
        """Append a record."""
        channel = self._channels.get(record.topic)
        if channel is None:
            self.unknown += 1
            return
        second = record.publish_ns // SECOND
        if second != self._second:
            self.flush()
            self._second = second
        self.waiting += 1
        self._writer.add_message(channel, record.publish_ns, record.data, record.publish_ns)  # logged as it is published

    def flush(self) -> None:
        """End the chunk, so that its records survive a crash of this process."""
        if self.waiting:
            self._writer.flush()
            self._flushed()

    def close(self) -> None:
        """Write the rest and the index. Closing twice does nothing."""
        if not self._out.closed:
            self._writer.finish()
            self._out.flush()
            self._flushed()
            self._out.close()

    def abandon(self) -> None:
        """After an OSError: keep the complete chunks, or remove an empty file. The index is missing, see `repair`. Raises
        OSError."""
        self._out.cut()
        if not self.size:
            self._path.unlink(missing_ok=True)

    def _flushed(self) -> None:
        self.written += self.waiting
        self.waiting = 0

    def __enter__(self) -> McapFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except OSError:
            self.abandon()
            raise


class _Out:
    """Collects the writer's bytes and writes them in whole chunks, so that a full disk leaves no part of one behind."""

    def __init__(self, path: Path) -> None:
        self.written = 0
        self._file = FileIO(path, "wb")
        self._gathered = bytearray()

    @property
    def closed(self) -> bool:
        return self._file.closed

    def write(self, data: bytes) -> None:
        self._gathered += data

    def tell(self) -> int:
        return self.written + len(self._gathered)

    def flush(self) -> None:
        rest = memoryview(bytes(self._gathered))
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._file.name)) from error
        self.written += len(self._gathered)
        self._gathered.clear()

    def cut(self) -> None:
        with self._file:
            self._file.truncate(self.written)

    def close(self) -> None:
        self._file.close()


def _metadata(config: Config) -> dict[str, str]:
    table = msgspec.json.encode(config_table(config), order="deterministic").decode()
    return {"version": __version__, "vehicle": config.vehicle.name, "config": table}


def _registered(writer: Writer, channel: Channel) -> int:
    schema = writer.register_schema(channel.schema_name, "jsonschema", channel.schema)
    number: int = writer.register_channel(channel.topic, "json", schema)
    return number


# --- Live


class McapRecorder:
    """The live output: files of bounded size in a folder, of which the oldest are removed."""

    name = "mcap"

    def __init__(self, config: Config, folder: Path) -> None:
        self.about = f"MCAP files in {folder}"
        self.outbox = Outbox(MAX_WAITING, SHOWN)
        self.lost = self.files = 0
        self._folder, self._config = folder, config
        section = config.mcap
        self._file_bytes = int(section.file_mb * MEGABYTE)
        self._bounded = BoundedFolder(folder, re.escape(KIND), self._file_bytes, int(section.total_mb * MEGABYTE))
        self._converter = Converter(section.rate_hz)
        self._file: McapFile | None = None
        self._ended = 0  # records in the files before it
        self._chunk = 0  # largest so far [bytes]

    def session(self, stop: Event) -> None:
        """Write until `stop` is set. Raises OutputLost."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._run(stop)
        except OSError as error:
            raise OutputLost(f"{error.filename or self._folder}: {error.strerror}") from error

    def counts(self) -> dict[str, int]:
        """Records written, records lost (also those of unknown topics), and files."""
        file = self._file
        written, unknown = (file.written, file.unknown) if file else (0, 0)
        return {"records": self._ended + written, "records lost": self.lost + unknown, "files": self.files}

    def notes(self) -> dict[str, str]:
        """The folder of the files."""
        return {"folder": str(self._folder)}

    def _run(self, stop: Event) -> None:
        idle_s = 0.0
        stopping = False
        while not stopping:
            stopping = stop.is_set()  # read before the last poll, so that no message is missed
            found = self.outbox.take(POLL_S)
            idle_s = 0.0 if found else idle_s + POLL_S
            batch = [record for message in found for record in self._converter.records(message)]
            done = 0
            try:
                for record in batch:
                    self._add(record)
                    done += 1
                if self._file and idle_s > FLUSH_S:
                    self._file.flush()
                if self._file and stopping:
                    self._leave_file(McapFile.close)
            except OSError:
                self.lost += len(batch) - done + (self._file.waiting if self._file else 0)
                self._leave_file(McapFile.abandon)
                raise

    def _add(self, record: Record) -> None:
        if self._file and self._file.written and self._file.size + 2 * self._chunk > self._file_bytes:
            self._leave_file(McapFile.close)
        if self._file is None:
            self._file = McapFile(self._bounded.new_file(record.publish_ns, KIND), self._config)
            self.files += 1
        size = self._file.size
        self._file.add(record)
        self._chunk = max(self._chunk, self._file.size - size)

    def _leave_file(self, how: Callable[[McapFile], None]) -> None:
        if self._file:
            how(self._file)
            file, self._file = self._file, None
            self._ended += file.written
            self.lost += file.unknown


def make(config: Config, _: OutputContext) -> Sequence[LiveOutput]:
    """The output of a configuration with a folder."""
    assert config.mcap.folder is not None
    return [McapRecorder(config, config.path(config.mcap.folder))]


# --- Repair


def repair(cut: Path, whole: Path) -> tuple[int, str | None]:
    """Copy the intact part of a file into another. Returns the number of messages, and why reading stopped early, if it did.
    Raises OSError."""
    messages, ids, reason = 0, dict[int, int](), None
    with cut.open("rb") as damaged, whole.open("wb") as target:
        writer = Writer(target, chunk_size=CHUNK_BYTES)
        writer.start(library=LIBRARY)
        try:
            for record in StreamReader(damaged, validate_crcs=True).records:
                if isinstance(record, records.DataEnd):
                    break  # a copy of the schemas and channels follows
                messages += isinstance(record, records.Message)
                _copy(record, writer, ids)
        except (McapError, ZstdError, ValueError, struct.error) as error:
            reason = str(error) or "cut off"
        writer.finish()
    return messages, reason


def _copy(record: records.McapRecord, writer: Writer, ids: dict[int, int]) -> None:
    """`ids` are the channels' new numbers by their old ones."""
    if isinstance(record, records.Schema):
        writer.register_schema(record.name, record.encoding, record.data)
    elif isinstance(record, records.Channel):
        ids[record.id] = writer.register_channel(record.topic, record.message_encoding, record.schema_id, record.metadata)
    elif isinstance(record, records.Metadata):
        writer.add_metadata(record.name, record.metadata)
    elif isinstance(record, records.Message):
        writer.add_message(ids[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence)


def main(argv: Sequence[str] | None = None) -> int:
    """python -m fusiond_adapters.mcap"""
    parser = argparse.ArgumentParser(prog="python -m fusiond_adapters.mcap", description="Repair an MCAP file cut off.")
    parser.add_argument("cut", type=Path, metavar="CUT.mcap")
    parser.add_argument("whole", type=Path, metavar="WHOLE.mcap", help="written; must not be the same file")
    arguments = parser.parse_args(argv)
    if arguments.whole.exists():
        parser.error(f"{arguments.whole} exists already")
    try:
        messages, reason = repair(arguments.cut, arguments.whole)
    except OSError as error:
        print(f"{error.filename}: {error.strerror}", file=sys.stderr)
        return 1
    print(f"{messages} messages in {arguments.whole}" + (f"; the rest is unusable: {reason}" if reason else ""))
    return 0


if __name__ == "__main__":
    sys.exit(main())
