"""Every sentence that a user reads is in plain English of the field, and helps fit a screen."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import ipe_bench
from ipe_bench.cli.main import COMMANDS
from ipe_bench.cli.parser import parser_of, program

ROOT = Path(__file__).parents[2]
PACKAGE = Path(ipe_bench.__file__).parent
PAGES = PACKAGE / "report" / "docs" / "pages"
FORBIDDEN = {
    r"\bthat of\b|\bthose of\b": "repeat the noun",
    r"\bof the same[,.;:]": "repeat the noun",
    r"\bsurely\b": "significantly, or no evidence against",
    r"\bas many\b": "name the number",
    r"\bto be had\b|\bwhat was asked for\b": "say what is missing",
    r"\b(?<!_)honest(ly)?\b": "a right covariance; overconfident",
    r"\breadings? (say|tell)s?\b|\bdata can(not)? tell\b": "readings determine, or distinguish",
    r"\b(tells?|told)( \S+){0,4} apart\b": "distinguish",
    r"\bnotic(e|es|ed|ing)\b": "detect",
    r"\bwithout a word\b|\bsilent(ly)?\b": "undetected",
    r"(?:^|[.:;] )No (choice|data|rivals?) ": "no negation as subject",
    r"(?:^|[ (|*±-])\.\d": "a zero before the point",
}
"""What a reader stumbles over, with what to write."""
RETIRED = dict(
    line.split("\t")
    for line in Path(__file__).with_name("retired_words.tsv").read_text("utf-8").splitlines()
)
"""Phrases that must not come back, with what replaced them; {} is what is filled in."""


def retired(text: str) -> list[str]:
    """Returns the retired phrases of a text, in which {} is what is filled in."""
    return [f"{phrase}: {better}" for phrase, better in RETIRED.items() if phrase in text]


def stumbles(text: str) -> list[str]:
    """Returns the phrases of a text that are forbidden, with the remedy; code, files and links are
    no text."""
    read = re.sub(r"`[^`\n]*`|\]\([^)]*\)|\[[^]]*\]\(reference/checked[^)]*\)", "", text)
    return [
        f"{found[0]}: {remedy}"
        for phrase, remedy in FORBIDDEN.items()
        for found in re.finditer(phrase, read, re.IGNORECASE)
    ]


def strings(module: ast.Module) -> Iterator[ast.expr]:
    """Yields the strings of a module that are no docstrings, joined ones as a whole."""
    parts = {
        id(part)
        for node in ast.walk(module)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    docstrings = {id(node.value) for node in ast.walk(module) if isinstance(node, ast.Expr)}
    for node in ast.walk(module):
        if isinstance(node, ast.JoinedStr | ast.Constant) and id(node) not in parts | docstrings:
            yield node


def said(node: ast.expr, filled: str = "X") -> str:
    """Returns the text of a string, with a word for what is filled in."""
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else filled for part in node.values
        )
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def sources() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if "templates" not in path.parts)


@pytest.mark.parametrize("room", sorted({path.relative_to(PACKAGE).parts[0] for path in sources()}))
def test_sentences_of_the_package_are_plain(room):
    """Strings of several words: messages, tables, legends, helps and captions."""
    found = {
        f"{path.relative_to(PACKAGE)}:{node.lineno}": wrong
        for path in sources()
        if path.relative_to(PACKAGE).parts[0] == room
        for node in strings(ast.parse(path.read_text(encoding="utf-8")))
        if " " in said(node) and (wrong := stumbles(said(node)))
    }
    assert not found


WRITTEN = [*PAGES.rglob("*.md"), *(ROOT / "conf").rglob("*.yaml"), ROOT / "README.md"]


@pytest.mark.parametrize("page", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_and_configs_are_plain(page):
    """Rows of checked.md are the names of tests."""
    lines = page.read_text(encoding="utf-8").splitlines()
    if page.name == "checked.md":
        lines = [line for line in lines if not line.startswith("|")]
    if page.suffix == ".yaml":
        lines = [line.partition("#")[2] for line in lines]
    assert stumbles("\n".join(lines)) == []


@pytest.mark.parametrize("folder", ["ipe_bench", "conf", "plugins"])
def test_retired_phrases_do_not_come_back(folder):
    """In strings of modules, in pages and in configs."""
    read = {
        path: path.read_text(encoding="utf-8")
        for path in (ROOT / folder).rglob("*.*")
        if path.suffix in (".py", ".md", ".yaml", ".j2")
    }
    written = {
        path: "\n".join(said(node, "{}") for node in strings(ast.parse(text)))
        if path.suffix == ".py"
        else " ".join(text.split())
        for path, text in read.items()
    }
    found = {path: wrong for path, text in written.items() if (wrong := retired(text))}
    assert not found


@pytest.mark.parametrize("phrase", RETIRED)
def test_a_retired_phrase_is_found_where_it_stands(phrase):
    joined = ast.parse(f"f{phrase.replace('{}', '{x}')!r}").body[0]
    assert isinstance(joined, ast.Expr)
    assert retired(said(joined.value, "{}"))


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("in multiples of that of the filter", "that of"),
        ("Surely too small.", "Surely"),
        ("No data can tell: a, b.", "data can tell"),
        ("It fails silently.", "silently"),
        ("p below .05", " .0"),
        ("the share of failed_silent", ""),
        ("See [tracks](../checked.md#those-of-filterpy) and `that of`.", ""),
    ],
)
def test_what_a_reader_stumbles_over_is_found(text, phrase):
    assert [one.partition(":")[0] for one in stumbles(text)][:1] == ([phrase] if phrase else [])


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_helps_fit_80_columns(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = (parser_of(command) if command else program()).format_help()
    assert [line for line in text.splitlines() if len(line) > 80] == []
