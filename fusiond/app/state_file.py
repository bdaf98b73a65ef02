"""The file of the stored state: read at the start, replaced atomically, failures counted."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from fusiond.config.schema import Config
from fusiond.filter.hot_start import WORDS
from fusiond.filter.state import Verdict
from fusiond.filter.stored_state import (
    DamagedStateError,
    StoredState,
    StoredStateError,
    check,
    from_text,
    to_text,
    with_frame,
)
from fusiond.messages.types import OutputHealth
from fusiond.ports.outputs import KeptFrame
from fusiond_adapters.host.bounded_folder import sync_folder

MAX_BYTES = 1_000_000  # a larger file was not written by fusiond

log = logging.getLogger("fusiond")


def read_state(path: Path) -> StoredState | None:
    """The stored state in the file; None if there is no file yet. Raises StoredStateError."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoredStateError(f"cannot be read: {error.strerror}") from error
    if len(text) > MAX_BYTES:
        raise DamagedStateError("torn or altered: it is too large")
    return from_text(text)


class StateFile:
    """Reads the stored state of the last run, and writes new ones. A reader of the file finds the old state or the new one,
    never a part. The local frame of an autopilot is kept with it, and is of use where the state itself is not."""

    def __init__(self, path: Path, config: Config, now_ns: int) -> None:
        self.stored: StoredState | None = None  # of the last run, if it can be used
        self.frame = KeptFrame()  # of the last run; an output goes on with it
        self.written = self.lost = 0
        self.error: str | None = None  # the last one, until a write succeeds
        self._path = path
        self._cold = "there is none yet"
        self._logged = Verdict.NONE
        try:
            stored = read_state(path)
            if stored is not None:
                if stored.vehicle == config.vehicle.name:
                    self.frame = KeptFrame(stored.origin, stored.reset_counter)
                check(stored, config, now_ns)
                self.stored = stored
        except StoredStateError as error:
            self._cold = str(error)
            kept = f"; kept as {self._set_aside()}" if isinstance(error, DamagedStateError) else ""
            log.warning("stored state ignored: %s: %s%s", path, error, kept)

    def _set_aside(self) -> Path:
        """Rename the file, so that the next one does not replace it. Returns its path."""
        aside = self._path.with_name(self._path.name + ".damaged")
        try:
            self._path.replace(aside)
        except OSError:  # a disk that is read-only: it stays as it is, and is ignored again
            return self._path
        return aside

    def health(self, verdict: Verdict) -> OutputHealth:
        """Counts of writes and failures, and the verdict on the stored state, which is logged once when it is decided."""
        about = WORDS[verdict] if self.stored else f"ignored: {self._cold}"
        if verdict is not self._logged:
            self._logged = verdict
            log.info("stored state: %s", about)
        notes = {"hot_start": about} | ({"error": self.error} if self.error else {})
        return OutputHealth(offered=self.written + self.lost, dropped=self.lost, counts={}, notes=notes)

    def write(self, stored: StoredState) -> None:
        """Replace the file durably, with the local frame of now. A failure is counted, and leaves the file as it was."""
        try:
            self._replace(to_text(with_frame(stored, self.frame.origin, self.frame.reset_counter)))
        except OSError as error:
            self.lost += 1
            self.error = error.strerror or str(error)
        else:
            self.written += 1
            self.error = None

    def _replace(self, text: bytes) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self._path.with_name(self._path.name + ".new")
        try:
            with fresh.open("wb") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._path)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise
        sync_folder(self._path.parent)
