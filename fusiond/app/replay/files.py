"""The files of a replay besides the logs: stored state and truth to read, track and MCAP to write."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fusiond.app.replay.comparison import Errors
from fusiond.app.replay.truth import Truth, TruthError, TruthSample, parse_truth
from fusiond.app.state_file import read_state
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.errors import OutputError, UsageError
from fusiond.filter.stored_state import StoredState, StoredStateError, check
from fusiond.messages import Message, StateMessage, csv_header, csv_row
from fusiond_adapters.logs.file import LogError

# --- Input


def stored_state(path: Path, config: Config) -> StoredState:
    """The stored state that a recording started with. Raises LogError."""
    try:
        stored = read_state(path)
        if stored is None:
            raise StoredStateError("there is no such file")
        check(stored, config)
    except StoredStateError as error:
        raise LogError(f"{path}: {error}") from error
    return stored


def truth_of(path: Path) -> Truth:
    """A reference track; a first pass detects any error in the file. Raises TruthError."""
    samples = _TruthFile(path)
    for _ in samples:
        pass
    return Truth(samples)


class _TruthFile:
    """The samples of a file, read anew each time."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __iter__(self) -> Iterator[TruthSample]:
        return _read_truth(self._path)


def _read_truth(path: Path) -> Iterator[TruthSample]:
    opener = gzip.open if path.suffix.lower() == ".gz" else open
    try:
        with opener(path, "rt", encoding="utf-8") as file:
            yield from parse_truth(file, str(path))
    except UnicodeDecodeError as error:
        raise TruthError(f"{path}: is not UTF-8 text") from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TruthError(f"{path}: is not a valid gzip file: {error}") from error
    except OSError as error:
        raise TruthError(f"{path}: cannot be read: {error.strerror}") from error


# --- Output


@contextmanager
def delivering(path: Path) -> Iterator[None]:
    """Inside the block an OSError becomes an OutputError that names the file."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Check before the work begins whether files can be written. Raises UsageError, OutputError."""
    read = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in read:
            raise UsageError(f"{path}: is an input, and would be overwritten")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: cannot be written: there is no folder {path.parent}")


def check_suffix(option: str, path: Path | None, suffix: str) -> None:
    """Raises UsageError where a file has not the suffix of what is written into it."""
    if path is not None and path.suffix.lower() != suffix:
        kind = suffix.removeprefix(".").upper()
        raise UsageError(f"{option} {path}: what is written is {kind}; give a name that ends in {suffix}")


def csv_file(path: Path, stack: ExitStack) -> Callable[[StateMessage, Errors | None], None]:
    """Open a track until the stack closes; returns a function that writes a line. Raises OutputError."""
    with delivering(path):
        file = stack.enter_context(path.open("w", encoding="ascii", newline="\n"))
        file.write(csv_header() + "\n")

    def write_line(state: StateMessage, _: Errors | None) -> None:
        file.write(csv_row(state) + "\n")

    return write_line


def mcap_file(path: Path, config: Config, stack: ExitStack) -> Callable[[Message], None]:
    """Open an MCAP file until the stack closes; returns a function that writes a message. Raises UsageError, OutputError."""
    try:
        from fusiond_adapters.foxglove.converter import Converter  # noqa: PLC0415 - needs the extra `mcap`
        from fusiond_adapters.mcap import McapFile  # noqa: PLC0415
    except ConfigError as error:
        raise UsageError(f"--mcap: {error}") from error

    with delivering(path):
        file = stack.enter_context(McapFile(path, config))
    converter = Converter()

    def write(message: Message) -> None:
        for record in converter.records(message):
            file.add(record)

    return write


# --- Names


def short_names(paths: Iterable[str]) -> dict[str, str]:
    """File names for the paths in the summary; equal names are numbered."""
    names: dict[str, str] = {}
    for path in paths:
        name = Path(path).name
        same = sum(Path(other).name == name for other in names)
        names[path] = f"{name} ({same + 1})" if same else name
    return names


def with_short_names(text: str, names: dict[str, str]) -> str:
    """A text with the names instead of the paths."""
    for path, name in names.items():
        text = text.replace(path, name)
    return text
