"""The page in a real browser: no errors, sorting and filtering work, it fits a phone and prints."""

from __future__ import annotations

import re

import numpy as np
import pytest
from synthetic_store import Synthetic
from test_report import HOSTILE, fill

from ipe_bench.report import write_report

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
    result = write_report([store.directory], store.directory)
    assert result.problems
    return result.report


@pytest.fixture
def desktop(browser, page_file):
    browser.messages.clear()
    browser.requests.clear()
    browser.go(page_file)
    return browser


def column(page, table: str, index: int) -> list[str]:
    script = (
        f"Array.from(document.querySelectorAll('#table-{table} tbody tr')).filter(r => !r.hidden)"
        f".map(r => r.cells[{index}].textContent)"
    )
    return page.run(script)


def heading(page, table: str, title: str) -> int:
    titles = page.run(f"Array.from(document.querySelectorAll('#table-{table} th'), h => h.textContent)")
    return titles.index(title)


def click(page, table: str, index: int) -> None:
    page.run(f"document.querySelectorAll('#table-{table} th [role=button]')[{index}].click()")


def test_there_are_no_errors_no_dialogs_and_no_requests(desktop):
    assert desktop.messages == []
    outside = [url for url in desktop.requests if not url.startswith(("file:", "data:"))]
    assert outside == []
    assert HOSTILE in desktop.run("document.body.innerText")


def test_every_figure_is_decoded(desktop, page_file):
    widths = desktop.run("Array.from(document.images, i => i.naturalWidth)")
    drawn = {path.stem for path in (page_file.parent / "figures").glob("*.png")}
    assert {"success_against_scale", "error_distributions", "correlation"} < drawn
    assert len(widths) == len(drawn)
    assert min(widths) > 300


def test_columns_sort_by_number_and_by_word(desktop):
    at = heading(desktop, "overview", "efficiency")
    click(desktop, "overview", at)
    values = [float(v.replace(",", "")) for v in column(desktop, "overview", at) if v != "-"]
    assert values == sorted(values)
    assert column(desktop, "overview", at)[-1] == "-"
    click(desktop, "overview", at)
    values = [float(v.replace(",", "")) for v in column(desktop, "overview", at) if v != "-"]
    assert values == sorted(values, reverse=True)
    sort = f"document.querySelectorAll('#table-overview th')[{at}].getAttribute('aria-sort')"
    assert desktop.run(sort) == "descending"
    name = heading(desktop, "overview", "estimator")
    click(desktop, "overview", name)
    names = column(desktop, "overview", name)
    assert names == sorted(names, key=str.lower)


def test_rows_are_filtered_by_words_and_whole_numbers(desktop):
    script = (
        "(function (text) { const i = document.querySelector('.tools input[data-table=table-overview]');"
        " i.value = text; i.dispatchEvent(new Event('input'));"
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
    # Tables scroll in a box of their own.
    box = "document.querySelector('#table-overview').parentElement"
    assert browser.run(f"{box}.scrollWidth > {box}.clientWidth")
    assert browser.run(f"{box}.getBoundingClientRect().right") <= 390


def test_it_prints(desktop):
    pdf = desktop.pdf()
    pages = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert 4 <= pages <= 60
    # Nothing runs off the paper: 297 mm less two margins of 12 mm, at 96 pixels an inch.
    width = round((297 - 24) / 25.4 * 96)
    desktop.call("Emulation.setEmulatedMedia", media="print")
    desktop.call("Emulation.setDeviceMetricsOverride", width=width, height=700, deviceScaleFactor=1, mobile=False)
    try:
        assert desktop.run("document.documentElement.scrollWidth") <= width
    finally:
        desktop.call("Emulation.setEmulatedMedia", media="")
