"""The page in a real browser: no errors, sorting and filtering work, it fits a phone and prints."""

from __future__ import annotations

import io
import re

import numpy as np
import pandas as pd
import pytest
from shared.reports import HOSTILE, fill
from shared.synthetic_store import Synthetic

from ipe_bench.api import report as write_report
from ipe_bench.report.tables.table import csv_text

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    store = Synthetic(tmp_path_factory.mktemp("page") / "store")
    fill(store, labels=("linear_lse", "one", "two", HOSTILE), names=("a", "b", HOSTILE))
    # A cell with failures and messages, some of them long, and one that is missing.
    scenario = store.scenario(error_scale=1.0, names=("a", "b", HOSTILE))
    e = np.full((80, 3), np.nan)
    message = np.array(["LinAlgError: " + "x" * 300, HOSTILE] * 40, dtype=object)
    store.add(scenario, "failing", e, status="error", message=message, solved=False)
    store.record(100, "more")
    result = write_report([store.directory], store.directory, figures="all")
    assert result.problems
    return result.report


@pytest.fixture
def desktop(browser, page_file):
    browser.messages.clear()
    browser.requests.clear()
    browser.go(page_file)
    # Folded parts are laid out when they are opened.
    browser.run("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    return browser


def column(page, table: str, index: int) -> list[str]:
    script = (
        f"Array.from(document.querySelectorAll('#table-{table} tbody tr')).filter(r => !r.hidden)"
        f".map(r => r.cells[{index}].textContent)"
    )
    return page.run(script)


def heading(page, table: str, title: str) -> int:
    titles = page.run(
        f"Array.from(document.querySelectorAll('#table-{table} th'), h => h.textContent)"
    )
    return titles.index(title)


def click(page, table: str, index: int) -> None:
    page.run(f"document.querySelectorAll('#table-{table} th [role=button]')[{index}].click()")


def test_there_are_no_errors_no_dialogs_no_requests_and_all_figures(desktop, page_file):
    assert desktop.messages == []
    outside = [url for url in desktop.requests if not url.startswith(("file:", "data:"))]
    assert outside == []
    assert HOSTILE in desktop.run("document.body.innerText")
    widths = desktop.run(
        "Array.from(document.querySelectorAll('figure'), f => f.getBoundingClientRect().width)"
    )
    drawn = {path.stem for path in (page_file.parent / "figures").glob("*.png")}
    assert "headline" in drawn
    # The matrix and its success are one table here, and their pictures links at the end.
    assert len(widths) == len(drawn - {"matrix", "success"})
    assert min(widths) > 300


def test_the_page_is_dark_where_the_reader_has_it_so(desktop, page_file):
    color = "getComputedStyle(document.body).backgroundColor"
    assert desktop.run(color) == "rgb(255, 255, 255)"
    desktop.call(
        "Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}]
    )
    try:
        assert max(map(int, re.findall(r"\d+", desktop.run(color)))) < 50
        # Figures are dark by their own colours: the axes' ground is the page's, and their letters
        # are light.
        fill = "(e => getComputedStyle(document.querySelector(e)).fill)"
        assert desktop.run(f"{fill}('.panels svg path')") == desktop.run(color)
        assert min(map(int, re.findall(r"\d+", desktop.run(f"{fill}('.panels text')")))) > 150
    finally:
        desktop.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "light"}],
        )


def test_the_page_opens_with_the_answer_and_a_link_unfolds_the_rest(browser, page_file):
    browser.go(page_file)
    order = browser.run(
        "['h1', '#figure-headline', '.folds', '.about'].map(s =>"
        " document.querySelector(s).getBoundingClientRect().y)"
    )
    assert order == sorted(order)
    # The facts stand beside the matrix, and both end where the title's line does.
    first, facts, line = browser.run(
        "['.matrices', '#headline', 'header'].map(s => document.querySelector(s)"
        ".getBoundingClientRect()).map(b => [b.left, b.right, b.top])"
    )
    assert first[0] == line[0]
    assert facts[1] == line[1]
    assert facts[2] == first[2] > order[0]
    assert browser.run(
        "Array.from(document.querySelectorAll('details.part'), d => d.open).every(o => !o)"
    )
    browser.run("location.hash = '#tables'; unfold()")
    assert browser.run("document.querySelector('#tables').closest('details').open")
    assert not browser.run("document.querySelector('#definitions').closest('details').open")


CELL = "document.querySelector('.matrix').rows[2].cells[1]"
SHOWN = (
    f"Array.from({CELL}.querySelectorAll('span')).filter(s => s.offsetWidth)"
    ".map(s => s.classList[0])"
)


def test_a_choice_shows_another_number_in_every_cell_without_a_script(browser, page_file):
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.go(page_file)
        assert browser.run(SHOWN) == ["success"]
        assert re.match(r"\S+, error scale .* success .* trials", browser.run(f"{CELL}.title"))
        for view in ("error", "nees", "cost"):
            browser.run(f"document.querySelector('.views [value={view}]').click()")
            assert browser.run(SHOWN) == [view]
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)


def test_a_cell_tells_what_it_knows_to_pointer_finger_and_keyboard(desktop):
    told = "(t => t.hidden ? '' : t.textContent)(document.querySelector('.told'))"
    assert desktop.run(told) == ""
    knows = desktop.run(f"{CELL}.dataset.says")
    for event in (
        "new PointerEvent('pointerover', {bubbles: true})",
        "new Event('click', {bubbles: true})",
    ):
        desktop.run(f"{CELL}.dispatchEvent({event})")
        assert desktop.run(told) == knows
        desktop.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
        assert desktop.run(told) == ""
    # One stop of the tabulator; arrows go on from there.
    assert desktop.run("document.querySelectorAll('.matrix td[tabindex=\"0\"]').length") == 1
    arrow = (
        "document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowDown',"
        " bubbles: true}))"
    )
    desktop.run(f"{CELL}.focus(); {arrow}")
    assert desktop.run(told) == desktop.run(
        "document.querySelector('.matrix').rows[3].cells[1].dataset.says"
    )


def test_a_click_on_a_name_fades_the_others(desktop):
    faded = "Array.from(document.querySelectorAll('.matrix tr.faded'), r => r.dataset.name)"
    names = desktop.run(
        "Array.from(document.querySelectorAll('.matrix tbody tr'), r => r.dataset.name)"
    )
    second = "document.querySelectorAll('.matrix tbody th')[1]"
    desktop.run(f"{second}.dispatchEvent(new KeyboardEvent('keydown', {{key: 'Enter'}}))")
    assert desktop.run(faded) == [name for name in names if name != names[1]]
    desktop.run("document.querySelectorAll('.matrix tbody th')[0].click()")
    assert desktop.run(faded) == names[2:]
    desktop.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    assert desktop.run(faded) == []


def test_columns_sort_by_number_and_by_word(desktop):
    at, name = heading(desktop, "overview", "efficiency"), heading(desktop, "overview", "estimator")
    for last, order in ((False, "ascending"), (True, "descending")):
        click(desktop, "overview", at)
        values = [float(v.replace("<", "")) for v in column(desktop, "overview", at)]
        assert values == sorted(values, reverse=last)
        sort = f"document.querySelectorAll('#table-overview th')[{at}].getAttribute('aria-sort')"
        assert desktop.run(sort) == order
    click(desktop, "overview", name)
    names = column(desktop, "overview", name)
    assert names == sorted(names, key=str.lower)


def test_rows_are_filtered_by_words_and_whole_numbers(desktop):
    script = (
        "(function (text) { const i = document.querySelector('.tools"
        " input[data-table=table-overview]'); i.value = text; i.dispatchEvent(new Event('input'));"
        " return i.parentElement.querySelector('output').textContent; })"
    )
    assert desktop.run(f"{script}('TWO 10')") == "1 of 13 rows"
    assert column(desktop, "overview", heading(desktop, "overview", "estimator")) == ["two"]
    assert column(desktop, "overview", heading(desktop, "overview", "error scale")) == ["10"]
    assert desktop.run(f"{script}('')") == "13 rows"


def test_a_phone_never_scrolls_the_page_sideways(browser, page_file):
    browser.go(page_file, 390, 844, phone=True)
    assert browser.run("document.documentElement.scrollWidth") <= 390
    assert browser.run("document.body.scrollWidth") <= 390
    # Every letter of the first screen is at least 10 px high, also the sign of a covariance.
    sizes = browser.run(
        "Array.from(document.querySelectorAll('header *, .first *')).filter(e => e.offsetWidth)"
        ".map(e => parseFloat(getComputedStyle(e).fontSize))"
    )
    assert min(sizes) >= 10
    # The panels of a figure stand below each other.
    tops = browser.run(
        "Array.from(document.querySelectorAll('#figure-headline .panels svg'), s =>"
        " s.getBoundingClientRect().y)"
    )
    assert len(tops) == len(set(tops)) >= 2
    # The names of the curves in colour stand above each but the first, where they are at the
    # curves.
    names = browser.run(
        "Array.from(document.querySelectorAll('#figure-headline .names'), l => l.offsetHeight ?"
        " l.innerText : '')"
    )
    assert len(names) == len(tops) - 1
    assert all("one" in line and "two" in line for line in names)
    # Tables scroll in a box of their own.
    box = "document.querySelector('#table-overview').parentElement"
    assert browser.run(f"{box}.scrollWidth > {box}.clientWidth")
    assert browser.run(f"{box}.getBoundingClientRect().right") <= 390


def test_matrices_stand_side_by_side_and_below_each_other_on_a_phone(browser, tmp_path):
    store = Synthetic(tmp_path)
    for sigma in (1.25, 2.25, 3.25, 4.25, 5.25):
        fill(store, sigma=sigma, trials=30, scales=(1.0, 10.0), labels=("one", "two"))
    page = write_report([store.directory], store.directory).report
    lefts = "Array.from(document.querySelectorAll('.matrix'), m => m.getBoundingClientRect().left)"
    browser.go(page)
    assert len(set(browser.run(lefts))) > 1
    browser.go(page, 390, 844, phone=True)
    assert len(browser.run(lefts)) == 5
    assert len(set(browser.run(lefts))) == 1
    files = browser.run("Array.from(document.querySelectorAll('footer a'), a => a.textContent)")
    assert sum(name.startswith("matrix") for name in files) == 5
    assert sum(name.startswith("success") for name in files) == len(files) - 5 == 5
    assert browser.run("document.documentElement.scrollWidth") <= 390


def test_title_matrix_and_figure_stand_on_the_first_printed_page(browser, tmp_path):
    """An A4 page upright: 210 by 297 mm less two margins of 12 mm, at 96 pixels an inch."""
    width, height = (round((side - 24) / 25.4 * 96) for side in (210, 297))
    store = Synthetic(tmp_path)
    fill(store, labels=("linear_lse", *(f"estimator_{i}" for i in range(9))))
    browser.go(write_report([store.directory], store.directory).report)
    browser.call("Emulation.setEmulatedMedia", media="print")
    shape = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", **shape)
    try:
        boxes = "['h1', '.matrix', '#figure-headline'].map(s => document.querySelector(s)"
        places = browser.run(
            f"{boxes}.getBoundingClientRect()).map(b => [b.top, b.bottom, b.right])"
        )
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
    assert all(low < high <= height for low, high, _ in places)
    assert all(right <= width for *_, right in places)
    assert [place[0] for place in places] == sorted(place[0] for place in places)


def test_it_prints_and_the_answer_on_a_few_pages(browser, page_file, desktop):
    assert len(re.findall(rb"/Type\s*/Page\b", desktop.pdf())) <= 60
    # Nothing runs off the paper: 297 mm less two margins of 12 mm, at 96 pixels an inch.
    width = round((297 - 24) / 25.4 * 96)
    desktop.call("Emulation.setEmulatedMedia", media="print")
    desktop.call(
        "Emulation.setDeviceMetricsOverride",
        width=width,
        height=700,
        deviceScaleFactor=1,
        mobile=False,
    )
    try:
        assert desktop.run("document.documentElement.scrollWidth") <= width
    finally:
        desktop.call("Emulation.setEmulatedMedia", media="")
    browser.go(page_file)
    assert len(re.findall(rb"/Type\s*/Page\b", browser.pdf())) <= 4
    # The title, the matrix and the first figure stand on the first sheet, upright, if nothing is
    # missing.
    desktop.run("document.querySelector('.problems').remove()")
    desktop.call("Emulation.setEmulatedMedia", media="print")
    desktop.call(
        "Emulation.setDeviceMetricsOverride",
        width=round((210 - 24) / 25.4 * 96),
        height=900,
        deviceScaleFactor=1,
        mobile=False,
    )
    try:
        end = "document.querySelector('#figure-headline').getBoundingClientRect().bottom + scrollY"
        assert desktop.run(end) <= (297 - 24) / 25.4 * 96
        assert desktop.run("document.documentElement.scrollWidth") <= (210 - 24) / 25.4 * 96 + 1
    finally:
        desktop.call("Emulation.setEmulatedMedia", media="")


def test_a_spreadsheet_computes_no_name_of_a_csv_file():
    hostile = ["=HYPERLINK(1)", "+1+cmd|' /C calc'!A0", "@SUM(A1)", "-x", "-1+cmd|'x'!A"]
    plain = ["-", "-inf", "-1.5", "+19 % (9.6 to 29)", "newton", "-3.2 to 5", "-1e-05"]
    frame = pd.DataFrame({"=name": [*hostile, *plain], "number": np.arange(12.0) - 5})
    read = pd.read_csv(io.StringIO(csv_text(frame)), dtype=str, keep_default_na=False)
    assert read["'=name"].tolist() == [*(f"'{name}" for name in hostile), *plain]
    assert read["number"].astype(float).tolist() == frame["number"].tolist()
