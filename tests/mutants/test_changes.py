"""Changes on purpose can be made: each snippet stands once, what replaces it is Python, and its
tests are there."""

import ast

import pytest
from mutants.changes import CHANGES, changed, folded, places


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_stands_at_one_place_and_names_its_tests(name):
    change = CHANGES[name]
    found = list(places(change))
    assert len(found) == 1
    text = found[0][0].read_text(encoding="utf-8")
    other = changed(text, change)
    assert folded(other) == folded(text).replace(folded(change.before), folded(change.after))
    assert other != text
    ast.parse(other)
    for word in change.tests.split():
        assert any(path.name == word for path in change.files)
