"""The report in a real browser, headless: it draws every plot, links them in time and on the map, and asks no network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("bokeh", reason="needs the extra report")

from fusiond import __main__ as entry
from tests.helpers import drive
from tests.helpers.browser import Page, browser, opened

if browser() is None:
    pytest.skip("needs a browser: chromium", allow_module_level=True)

FRAME = (
    "(() => {{ const plot = Bokeh.documents[0].get_model_by_name('{name}'), view = Bokeh.index.find_one(plot);"
    " const box = view.frame.bbox, place = view.el.getBoundingClientRect();"
    " return [place.x + box.left, place.y + box.top, box.width, box.height]; }})()"
)
RANGE = "(() => { const t = Bokeh.documents[0].get_model_by_name('time'); return [t.start, t.end]; })()"
Y_RANGE = "(() => { const y = Bokeh.documents[0].get_model_by_name('speed').y_range; return [y.start, y.end]; })()"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    out = tmp_path_factory.mktemp("report") / "drive.html"
    folder: Path = drive.folder()
    logs = [str(folder / log) for log in drive.LOGS]
    arguments = ["--config", str(folder / "fusiond.toml"), "--truth", str(folder / "truth.csv"), "-o", str(out)]
    assert entry.main(["report", *logs, *arguments]) == 0
    with opened() as found:
        found.open(out)
        yield found


def frame(page: Page, name: str) -> list[float]:
    plot = f"Bokeh.documents[0].get_model_by_name('{name}')"
    page.value(f"Bokeh.index.find_one({plot}).el.scrollIntoView({{block: 'center'}})")
    page.pause()
    box: list[float] = page.value(FRAME.format(name=name))
    return box


def test_it_opens_without_a_network_and_without_an_error(page: Page) -> None:
    assert [address for address in page.requests if not address.startswith(("file:", "data:", "blob:"))] == []
    assert page.complaints == []


def test_every_plot_is_drawn(page: Page) -> None:
    """Of each plot some pixels are neither empty nor of one colour."""
    drawn = page.value(
        "[...document.querySelectorAll('figure.panel')].map(panel => {"
        " const find = (node) => { if (node.shadowRoot) { const c = find(node.shadowRoot); if (c) return c; }"
        "   for (const child of node.children ?? []) { if (child.tagName === 'CANVAS') return child;"
        "     const c = find(child); if (c) return c; } return null; };"
        " const canvas = find(panel);"
        " const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;"
        " return new Set(new Uint32Array(pixels.buffer)).size; })"
    )
    assert len(drawn) > 15
    assert min(drawn) > 5


def test_a_drag_zooms_all_plots_in_time_and_marks_the_stretch_on_the_map(page: Page) -> None:
    before, tall = page.value(RANGE), page.value(Y_RANGE)
    x, y, width, height = frame(page, "speed")
    page.drag((x + 0.5 * width, y + height / 2), (x + 0.75 * width, y + height / 2))
    start, stop = page.value(RANGE)
    length = before[1] - before[0]
    assert start == pytest.approx(before[0] + 0.5 * length, abs=0.02 * length)
    assert stop == pytest.approx(before[0] + 0.75 * length, abs=0.02 * length)
    shown = page.value("Bokeh.documents[0].get_model_by_name('north_error').x_range.start")
    assert shown == start
    t = page.value("Array.from(Bokeh.documents[0].get_model_by_name('track').data.t)")
    marked = page.value("Bokeh.documents[0].get_model_by_name('window').data.x.length")
    assert marked == sum(start <= one < stop for one in t) > 10
    assert page.value(Y_RANGE) != tall  # the axis fits what is shown
    page.value("document.getElementById('whole').click()")
    page.pause()
    assert page.value(RANGE) == before and page.value(Y_RANGE) == tall
    assert page.value("Bokeh.documents[0].get_model_by_name('window').data.x.length") == 0


def test_pointing_at_a_plot_shows_the_place_on_the_map(page: Page) -> None:
    x, y, width, height = frame(page, "speed")
    page.move(x + 0.6 * width, y + height / 2)
    (place,) = page.value("Array.from(Bokeh.documents[0].get_model_by_name('marker').data.x)")
    start, stop = page.value(RANGE)
    wanted = start + 0.6 * (stop - start)
    near = page.value(
        "(() => { const d = Bokeh.documents[0].get_model_by_name('track').data;"
        f" return d.x[d.t.findIndex(t => t >= {wanted})]; }})()"
    )
    assert place == pytest.approx(near, abs=1.0)


def test_a_click_on_the_legend_hides_a_curve_and_the_theme_turns_dark(page: Page) -> None:
    visible = "Bokeh.documents[0].get_model_by_name('speed.climb').visible"
    assert page.value(visible) is True
    page.value("document.querySelector('[data-curve=\"speed.climb\"]').click()")
    assert page.value(visible) is False
    colour = "Bokeh.documents[0].get_model_by_name('speed').below[0].major_label_text_color"
    light = page.value(f"String({colour})")
    page.value("document.getElementById('theme').click()")
    page.pause()
    assert page.value(f"String({colour})") != light
    assert page.complaints == []
