"""The report is one file that loads nothing, says what is missing, and shows what went in."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

pytest.importorskip("bokeh", reason="needs the extra report")

from fusiond import __main__ as entry
from fusiond.app.diagnosis.finding import NO_STATE, Finding
from fusiond.app.replay.files import truth_of
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.replay.trace import Trace
from fusiond.app.report import figures
from fusiond.app.report.gathered import Gathered
from fusiond.app.report.page import Report, html
from fusiond.filter.observations import MODELS as OBSERVATIONS
from fusiond.messages.info import info_message
from fusiond_adapters.logs.merge import open_logs
from tests.helpers import drive

SECTIONS = ("track", "errors", "motion", "health", "innovations", "latencies", "calibration", "events", "setup")
LOADS = re.compile(r"""<(?:script|link|img|iframe)[^>]*\s(?:src|href)=|@import|url\((?!["']?data:)""")


def report(compared: bool, tiles: str | None = None) -> Report:
    settings = drive.settings()
    task = ReplayTask(50.0, truth=truth_of(drive.folder() / "truth.csv") if compared else None)
    trace = Trace(lambda: run.engine.origin_ns)
    gathered = Gathered(settings, lambda: run.engine.origin_ns)
    task.on_tick += [trace.add_tick, gathered.add_tick]
    task.on_receipt += [trace.add_receipt, gathered.add_receipt]
    task.on_message.append(gathered.add_message)
    run = Replay(settings, task)
    run.run(open_logs([str(drive.folder() / log) for log in drive.LOGS], settings))
    trace.read_outcomes()
    gathered.finish(run.elapsed_ns, info_message(settings, run.fusion).sources)
    return Report(settings, run.summary("fusiond.toml", {}, ["one <script>alert(1)</script> & two"]), gathered, trace, tiles)


@pytest.fixture(scope="module")
def compared() -> str:
    return html(report(compared=True))


def own(page: str) -> str:
    """The page without the scripts of the plotting library."""
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_it_has_every_section_and_loads_nothing(compared: str) -> None:
    assert re.findall(r'<section id="(\w+)"', compared) == ["overview", *SECTIONS]
    assert LOADS.findall(own(compared)) == []
    assert "default-src &#39;none&#39;" in compared and "unsafe-eval" not in compared
    assert "Errors against the truth" in compared and "No truth was given" not in compared
    assert len(compared) < 3_000_000


def test_names_and_words_cannot_become_markup(compared: str) -> None:
    assert "<script>alert(1)" not in compared
    assert "one &lt;script&gt;alert(1)&lt;/script&gt; &amp; two" in compared


def test_without_a_truth_it_shows_sigmas_and_says_so() -> None:
    made = report(compared=False)
    page = html(made)
    assert "No truth was given" in page and "Position sigma" in page and "In 95 % ellipse" not in page
    assert f"{made.summary.sources['rear_left'].fused}</td>" in page


def test_what_doctor_finds_stands_at_the_top() -> None:
    made = report(compared=False)
    text, key = "wheels read 3.6 times the speed", "wheel.a.unit"
    wrong = Finding(kind="wheel_unit", text=text, key=key, place="c.toml:7", value='"km/h"')
    page = html(replace(made, summary=msgspec.structs.replace(made.summary, findings=[wrong])))
    assert page.index("Wheels read 3.6 times the speed") < page.index('<section id="track"')
    assert "c.toml:7: <code>wheel.a.unit = &#34;km/h&#34;</code>" in page


def test_without_a_state_it_says_so(tmp_path: Path) -> None:
    """Half a second is too short to start."""
    tlog = tmp_path / "drive.tlog"
    tlog.write_bytes((drive.folder() / "drive.tlog").read_bytes()[:6000])
    out = tmp_path / "drive.html"
    arguments = ["report", "--config", str(drive.folder() / "fusiond.toml"), str(tlog), "-o", str(out)]
    assert entry.main(arguments) == NO_STATE
    page = out.read_text(encoding="utf-8")
    assert "There was no state at any time" in page and '<p class="finding no_state"><b>Found</b>' in page
    assert "Nothing was received from front_left" in page


def test_every_kind_of_measurement_has_its_unit() -> None:
    assert set(figures.MODELS) == {model.name for model in OBSERVATIONS}


def test_tiles_open_their_server_and_nothing_else() -> None:
    page = html(report(compared=False, tiles="https://tile.example.org/{z}/{x}/{y}.png"))
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy.endswith("img-src data: blob: https://tile.example.org")


@pytest.mark.parametrize("address", ["tile.example.org/{z}/{x}/{y}", "https://tile.example.org/{z}/{x}.png"])
def test_a_wrong_address_of_tiles_is_refused(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        entry.main(["report", "--config", "c.toml", "drive.tlog", "-o", "out.html", "--tiles", address])
    assert "is not an address with" in capsys.readouterr().err
