"""What an unknown file seems to be, by its first bytes."""

from __future__ import annotations

import re

from fusiond_adapters.logs.file import LogFile

HEAD = 4096  # bytes looked at
MAGICS = (  # how a file begins, what it is, and the suffix that makes it readable
    (b"\xa3\x95\x80", "an ArduPilot DataFlash log", ".bin"),
    (b"ULog\x01\x12\x35", "a PX4 ULog", ".ulg"),
    (b"MDF     ", "an ASAM MDF file", ".mf4"),
    (b"UnFinMF ", "an unfinished ASAM MDF file", ".mf4"),
    (b"LOGG", "a Vector BLF", ".blf"),
    (b"\x89MCAP0\r\n", "an MCAP file", ".mcap"),
    (b"#ROSBAG V2.0", "a ROS 1 bag", ".bag"),
    (b"SQLite format 3\0", "an SQLite file: a ROS 2 bag, or python-can's", ".db3 or .db"),
    (b"\x1f\x8b", "a gzip file", ".gz"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file", ".zst"),
    (b"PK\x03\x04", "a zip archive: unpack it", ""),
    (b"7z\xbc\xaf", "a 7-Zip archive: unpack it", ""),
)
TEXTS = (  # the same by the text of a line
    (re.compile(rb"^\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#", re.M), "a candump -L log", ".log"),
    (re.compile(rb"^\s*date .*\n\s*base (hex|dec)", re.M), "a Vector ASC", ".asc"),
    (re.compile(rb"^;\$FILEVERSION", re.M), "a PEAK TRC", ".trc"),
    (re.compile(rb"^\$(GP|GN|GL)(GGA|RMC)", re.M), "NMEA 0183 of a receiver, which is not read", ""),
    (re.compile(rb"^FMT, 128, 89", re.M), "an ArduPilot log as text: take the .bin", ""),
    (re.compile(rb"^[\w ./\[\]()^-]+(,[\w ./\[\]()^-]+){2,}\r?$", re.M), "a table of comma-separated values", ".csv"),
)
TLOG = re.compile(rb"\x00[\x03-\x0e][\s\S]{6}[\xfd\xfe]")  # a stamp in microseconds since 1970, and a frame
CONFIG = re.compile(rb"^\[(vehicle|mavlink|can|imu|gnss|filter)[.\]]", re.M)


def guess(file: LogFile) -> str:
    """What a file seems to be, in words, and which name it should have; empty if that is not known. Raises LogError."""
    head = next(file.blocks(), b"")[:HEAD]
    if CONFIG.search(head):
        return "it seems to be a configuration: give it with --config"
    named = [found for found in MAGICS if head.startswith(found[0])]
    if not named and TLOG.match(head):
        return "it seems to be a MAVLink telemetry log: name it .tlog"
    texts = [] if b"\0" in head else [found for found in TEXTS if found[0].search(head)]
    for _, what, suffix in (*named, *texts):
        return f"it seems to be {what}" + (f": name it {suffix}" if suffix else "")
    return ""
