"""MAVLink 2 signing: frames signed and checked with one key, and a timestamp that never decreases, not even after a restart.

Timestamps count 10 us since 2015 and follow the wall clock. On disk are two: one that was sent, and one that is not passed
before the two are written again, a minute later. After a restart the wall clock goes on, unless it is behind the first: it
was set back. Only then do timestamps run ahead of it, from the second on, by one for each frame; and the second is then a
second ahead of the first, so that restarts do not add up to more than the peers tolerate (a minute).
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
import time
from pathlib import Path
from typing import Any

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.units import SECOND
from fusiond_adapters.mavlink.decoder import CHECKSUM, HEADER_2, MAGIC_2, SIGNED

KEY_SIZE = 32  # bytes
SIGNATURE_SIZE, DIGEST_SIZE = 13, 6  # bytes: link, timestamp (6), digest (6)
EPOCH_NS = 1_420_070_400 * SECOND  # 2015
TICK_NS = 10_000
A_SECOND = SECOND // TICK_NS  # in timestamps
MINUTE = 60 * A_SECOND
BURST = A_SECOND // 100  # frames sent at once bring the timestamp less than this ahead of the clock
MAX_FILE_CHARACTERS = 100  # read of either file


class Signing:
    """The signing of one link. Raises ConfigError where the key or the timestamp cannot be read."""

    def __init__(self, config: Config, link: str) -> None:
        settings = config.mavlink[link]
        assert settings.signing_key_file is not None and settings.signing_timestamp_file is not None
        self._key = _read_key(config.path(settings.signing_key_file), f"mavlink.{link}.signing_key_file")
        self._file = config.path(settings.signing_timestamp_file)
        sent, self._limit = _read_timestamps(self._file, f"mavlink.{link}.signing_timestamp_file")
        self._last = sent if sent < _now() else self._limit
        self._accept_unsigned = settings.accept_unsigned
        self._streams: dict[tuple[int, int, int], int] = {}  # by link id, system and component: the latest timestamp
        self.counts = {"unsigned": 0, "wrongly signed": 0, "timestamp not kept": 0}

    def prepare(self, sender: Any) -> None:
        """Make a pymavlink MAVLink sign the next message it packs."""
        now = _now()
        self._last = max(self._last + 1, now)
        if self._last > self._limit or (self._last > now + BURST and self._limit > self._last + A_SECOND):
            self._store(self._last + (MINUTE if self._last == now else A_SECOND))
        sender.signing.secret_key = self._key
        sender.signing.sign_outgoing = True
        sender.signing.timestamp = self._last

    def accepts(self, frame: bytes) -> bool:
        """Whether a frame is signed with the key and newer than those before it, or may be unsigned. Others are counted."""
        if not is_signed(frame):
            self.counts["unsigned"] += not self._accept_unsigned
            return self._accept_unsigned
        good = self._good(frame)
        self.counts["wrongly signed"] += not good
        return good

    def _good(self, frame: bytes) -> bool:
        end = HEADER_2 + frame[1] + CHECKSUM
        signature = frame[end : end + SIGNATURE_SIZE]
        digest = hashlib.sha256(self._key + frame[:-DIGEST_SIZE]).digest()[:DIGEST_SIZE]
        if not hmac.compare_digest(digest, signature[-DIGEST_SIZE:]):
            return False
        timestamp = int.from_bytes(signature[1:-DIGEST_SIZE], "little")
        stream = (signature[0], frame[5], frame[6])
        last = self._streams.get(stream)
        if timestamp <= (max(self._last, _now()) - MINUTE if last is None else last):
            return False
        self._streams[stream] = timestamp
        return True

    def _store(self, limit: int) -> None:
        """Write, atomically, the last timestamp and the limit up to which others may be sent."""
        new = self._file.with_name(self._file.name + ".new")
        try:
            with new.open("w", encoding="ascii") as file:
                file.write(f"{self._last} {limit}\n")
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._file)
        except OSError:
            self.counts["timestamp not kept"] += 1  # the disk is full or read-only: sending must go on
        self._limit = limit


def is_signed(frame: bytes) -> bool:
    """Has a frame a signature, right or wrong?"""
    return frame[0] == MAGIC_2 and bool(frame[2] & SIGNED)


def _now() -> int:
    return (time.time_ns() - EPOCH_NS) // TICK_NS


def _read_key(path: Path, key: str) -> bytes:
    try:
        with path.open("rb") as file:
            mode, content = os.fstat(file.fileno()).st_mode, file.read(MAX_FILE_CHARACTERS)
    except OSError as error:
        raise ConfigError(f"{key}: {path}: cannot be read: {error.strerror}") from error
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise ConfigError(f"{key}: {path}: every user can read or write it; chmod o= {path}")
    if len(content) == KEY_SIZE:
        return content
    try:
        secret = bytes.fromhex(content.decode("ascii"))
    except ValueError:
        secret = b""
    if len(secret) != KEY_SIZE:
        raise ConfigError(f"{key}: {path}: {KEY_SIZE} bytes, or {2 * KEY_SIZE} hex digits, are needed")
    return secret


def _read_timestamps(path: Path, key: str) -> tuple[int, int]:
    """The stored timestamps: one that was sent, and the limit; 0 if there is no file yet."""
    if not path.parent.is_dir():
        raise ConfigError(f"{key}: no such folder: {path.parent}")
    try:
        words = path.read_text(encoding="ascii")[:MAX_FILE_CHARACTERS].split()
    except FileNotFoundError:
        return 0, 0
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{key}: {path}: cannot be read: {error}") from error
    if len(words) not in (1, 2) or not all(word.isdecimal() for word in words):
        raise ConfigError(f"{key}: {path}: holds no timestamp; remove it to start again")
    return int(words[0]), int(words[-1])
