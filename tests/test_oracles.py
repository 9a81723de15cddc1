"""Every mark `oracle` has its row, every row its mark, and every link to a row leads there."""

from __future__ import annotations

import re

from shared.oracles import PAGE, ROOT, Oracle, anchor, marked, rows, with_tables

PAGES = PAGE.parents[1]


def test_marks_and_rows_say_the_same():
    recorded = {row.test: Oracle(row.source, row.what, row.tolerance) for row in rows()}
    assert recorded == marked(), "`make oracles TESTS=FILE` records what the marks of a file say"
    assert len({anchor(test) for test in recorded}) == len(recorded)


def test_a_claim_that_links_to_a_row_has_it():
    page = with_tables(PAGE.read_text(encoding="utf-8"))
    there = set(re.findall(r'<a id="([^"]+)">', page))
    assert len(there) == len(rows())
    links = [
        (path.name, link)
        for path in (ROOT / "README.md", *ROOT.glob("plugins/**/README.md"), *PAGES.rglob("*.md"))
        for link in re.findall(r"checked\.md#([^)]+)\)", path.read_text(encoding="utf-8"))
    ]
    assert len(links) > 50
    assert [one for one in links if one[1] not in there] == []
