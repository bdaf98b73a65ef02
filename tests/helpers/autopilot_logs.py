"""Small logs as ArduPilot and PX4 write them: .bin and .ulg, made byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

FIX_UNIX_S = 1_600_000_000
GPS_S = FIX_UNIX_S + 18 - 315_964_800
WEEK, WEEK_MS = GPS_S // 604_800, GPS_S % 604_800 * 1000
CODES = {"Q": "Q", "B": "B", "I": "I", "f": "f", "H": "H", "c": "h", "C": "H", "e": "i", "L": "i", "Z": "64s", "h": "h"}
FACTORS = {"c": 100, "C": 100, "e": 100, "L": 1e7}

RECORDS = {  # name: type, format, columns
    "IMU": (130, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (131, "QBBIHBcLLeffff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw"),
    "GPA": (132, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
    "BARO": (133, "QBffc", "TimeUS,I,Alt,Press,Temp"),
    "WENC": (134, "QfBfB", "TimeUS,Dist0,Qual0,Dist1,Qual1"),
    "RWOH": (135, "ffIffff", "DA,DT,TS,PX,PY,PZ,R"),
    "ORGN": (136, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "XKF1": (137, "QBccCffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD"),
    "IMU2": (138, "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
}


def described(*names: str) -> bytes:
    """The FMT records of some kinds."""
    made = b""
    for name in names:
        kind, codes, columns = RECORDS[name]
        size = 3 + struct.calcsize("<" + "".join(CODES[code] for code in codes))
        made += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, name.encode(), codes.encode(), columns.encode())
    return made


def record(name: str, **values: float) -> bytes:
    """One record; what is not given is 0."""
    kind, codes, columns = RECORDS[name]
    body = b""
    for code, column in zip(codes, columns.split(","), strict=True):
        value = values.get(column, 0) * FACTORS.get(code, 1)
        body += struct.pack("<" + CODES[code], value if code == "f" else round(value))
    return b"\xa3\x95" + bytes((kind,)) + body


def fix(t_us: int, age_ms: int = 0, **more: float) -> bytes:
    """A GPS record of a fix that was received `age_ms` late; boot was 10 s before FIX_UNIX_S."""
    since_ms = t_us // 1000 - 10_000 - age_ms
    values = {"TimeUS": t_us, "Status": 3, "GMS": WEEK_MS + since_ms, "GWk": WEEK, "Lat": 48, "Lng": 11, "Alt": 500}
    return record("GPS", **values | {"Spd": 10, "GCrs": 90} | more)


def ulog(topics: Mapping[str, tuple[str, Sequence[Mapping[str, float]]]], dropout_ms: int = 0) -> bytes:
    """A ULog: by topic its fields, such as `uint64_t timestamp;float x;`, and its rows."""
    codes = {"uint64_t": "Q", "int32_t": "i", "uint32_t": "I", "float": "f", "double": "d", "uint8_t": "B"}
    made = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    made += _message("B", bytes(40))
    for name, (fields, _) in topics.items():
        made += _message("F", f"{name}:{fields}".encode())
    for number, name in enumerate(topics):
        made += _message("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        for row in rows:
            body = struct.pack("<H", number)
            for field in filter(None, fields.split(";")):
                kind, label = field.split(" ")
                kind, _, count = kind.partition("[")
                for part in range(int(count.rstrip("]") or 1)):
                    body += struct.pack("<" + codes[kind], row.get(f"{label}[{part}]" if count else label, 0))
            made += _message("D", body)
    return made + (_message("O", struct.pack("<H", dropout_ms)) if dropout_ms else b"")


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body
