"""Finding drives: folders as they lie, black boxes, patterns, manifests, object stores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import fsspec
import pyarrow as pa
import pytest
from pyarrow import parquet

from fusiond.app.batch.drives import find, in_folder
from fusiond.app.batch.job import Drive, DriveFile
from fusiond.app.batch.storage import Found
from fusiond.errors import UnusableError, UsageError


@pytest.fixture(autouse=True)
def inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def files(*names: str) -> None:
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(b"x" * 10)


def found(*arguments: str) -> dict[str, Drive]:
    return {drive.name: drive for drive in find(arguments)}


def names(drive: Drive) -> tuple[list[str], str | None, str | None]:
    return (
        [log.name for log in drive.logs],
        drive.truth.where if drive.truth else None,
        drive.config.where if drive.config else None,
    )


def test_every_folder_with_logs_is_a_drive() -> None:
    files("fleet/car1/a/drive.tlog", "fleet/car1/a/drive.log", "fleet/car1/a/truth.csv.gz", "fleet/car1/a/x.toml")
    files("fleet/car2/b/DRIVE.TLOG.GZ", "fleet/car2/readme.md", "fleet/car2/b/fusiond.toml", "fleet/car2/b/other.toml")
    drives = found("fleet")
    assert {name: names(drive) for name, drive in drives.items()} == {
        "fleet/car1/a": (["drive.log", "drive.tlog"], "fleet/car1/a/truth.csv.gz", "fleet/car1/a/x.toml"),
        "fleet/car2/b": (["DRIVE.TLOG.GZ"], None, "fleet/car2/b/fusiond.toml"),
    }
    assert drives["fleet/car1/a"].size == 20
    assert found("fleet/*") == drives


def test_logs_of_one_format_are_of_different_drives() -> None:
    files("logs/mon.tlog", "logs/mon.log", "logs/tue.tlog", "logs/mon.truth.csv", "logs/tue.toml", "logs/config.toml")
    assert {name: names(drive) for name, drive in found("logs").items()} == {
        "logs/mon": (["mon.log", "mon.tlog"], "logs/mon.truth.csv", "logs/config.toml"),
        "logs/tue": (["tue.tlog"], None, "logs/tue.toml"),
    }
    assert [names(drive)[0] for drive in find(["logs/tue.tlog"])] == [["tue.tlog"]]


def test_a_black_box_numbers_its_recordings() -> None:
    first, second = "box/0001-20260301T080000.000000Z-", "box/0002-20260301T090000.000000Z-"
    later = "box/0002-20260301T093000.000000Z-"
    files(f"{first}fc.tlog", f"{second}fc.tlog", f"{later}fc.tlog", f"{second}can.log", f"{second}state.json")
    files(f"{second}config.json", f"{second}car_0.dbc")
    drives = found("box")
    assert set(drives) == {"box/0001", "box/0002"}
    one = drives["box/0002"]
    assert [(log.link, log.where) for log in one.logs] == [
        ("", f"{second}can.log"), ("fc", f"{second}fc.tlog"), ("fc", f"{later}fc.tlog"),
    ]  # fmt: skip
    assert one.config == DriveFile(where=f"{second}config.json", name="config.json")
    assert one.beside == [DriveFile(where=f"{second}car_0.dbc", name="car_0.dbc")]
    assert one.stored is not None and drives["box/0001"].config is None


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_manifest_lists_drives(kind: str) -> None:
    files("data/a.tlog", "data/a.log", "data/b.tlog", "data/t.csv", "data/c.toml")
    if kind == "csv":
        rows = ["drive,logs,truth,config", "first,a.tlog; a.log,t.csv,c.toml", ",b.tlog,,", "lost,no.tlog,,"]
        Path("data/list.csv").write_text("\n".join(rows))
    else:
        table = {
            "drive": ["first", None, "lost"], "logs": [["a.tlog", "a.log"], ["b.tlog"], ["no.tlog"]],
            "truth": ["t.csv", None, None], "config": ["c.toml", None, None],
        }  # fmt: skip
        parquet.write_table(pa.table(table), "data/list.parquet")
    drives = found(f"data/list.{kind}")
    assert {name: names(drive) for name, drive in drives.items()} == {
        "first": (["a.tlog", "a.log"], "data/t.csv", "data/c.toml"),
        "data/b": (["b.tlog"], None, None),
        "lost": (["no.tlog"], None, None),  # told in its row
    }


@pytest.mark.parametrize(("text", "why"), [("log\na\n", "`logs` is needed"), ("logs\n \n", "row 1: no logs")])
def test_a_bad_manifest_is_refused(text: str, why: str) -> None:
    Path("list.csv").write_text(text)
    with pytest.raises(UsageError, match=why):
        found("list.csv")


@pytest.mark.parametrize("argument", ["nowhere", "no*where", "empty"])
def test_what_has_no_logs_is_told(argument: str) -> None:
    Path("empty").mkdir()
    with pytest.raises(UnusableError, match=argument.replace("*", r"\*")):
        found(argument)


@pytest.fixture
def store() -> Iterator[fsspec.AbstractFileSystem]:
    system = fsspec.filesystem("memory")
    yield system
    system.rm("/fleet", recursive=True)


def test_an_object_store_is_read_like_folders(store: fsspec.AbstractFileSystem) -> None:
    for name in ("car1/drive.tlog", "car1/wheels.dbc", "car1/fusiond.toml", "car2/drive.tlog"):
        store.pipe(f"/fleet/{name}", b"x")
    drives = found("memory://fleet/car*")
    assert set(drives) == {"memory:///fleet/car1", "memory:///fleet/car2"}
    one = drives["memory:///fleet/car1"]
    assert [file.where for file in one.files()] == [
        f"memory:///fleet/car1/{name}" for name in ("drive.tlog", "fusiond.toml", "wheels.dbc")
    ]
    assert all(file.is_remote for file in one.files())


def test_an_unknown_store_is_refused() -> None:
    with pytest.raises(UsageError, match="floppy"):
        found("floppy://a/b")


def stems(given: Sequence[str]) -> list[str]:
    return [drive.name for drive in in_folder("x", [Found(f"x/{name}", name, 1) for name in given])]


def test_packed_logs_have_the_stem_of_what_is_in_them() -> None:
    assert stems(["a.tlog", "a.log.gz", "b.tlog.gz"]) == ["x/a", "x/b"]
    assert stems(["a.tlog.gz", "b.log"]) == ["x"]
