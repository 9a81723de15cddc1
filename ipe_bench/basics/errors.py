"""Defines the exceptions that are meant for users; everything else that is raised is a bug."""

import difflib
import inspect
import os
import sys
import traceback
from collections.abc import Collection, Iterable, Sequence
from types import ModuleType
from typing import Any


class _Plain(Exception):
    """Is shown as one line, without a traceback."""

    def _render_traceback_(self) -> list[str]:
        """Returns the line that IPython prints in place of a traceback."""
        return [f"{type(self).__name__}: {' '.join(str(self).split())}"]


class UserError(_Plain):
    """Reports a mistake in a config, a command or a file: one line that names the key or row, and
    the remedy.

    The command line and a notebook print it without a traceback; the command line exits with code
    2.
    """


class StorageError(_Plain):
    """Results cannot be stored any more: a full disk, a folder that went away. One line.

    What was stored before is whole. The command line and a notebook print it without a traceback;
    the command line exits with code 1.
    """


class Unsuited(Exception):
    """Says in its own words why trials have no estimate."""


def one_line(text: Any) -> str:
    """Returns the first line of a text, at most 1000 letters of it, with ? for what no file can
    hold."""
    lines = str(text)[:1000].encode("utf-8", "replace").decode().splitlines()
    return lines[0] if lines else ""


def describe_exception(error: BaseException) -> str:
    """Describes an exception in one line for a table: its type, unless its words suffice, and the
    first line of its message."""
    line = one_line(error)
    if isinstance(error, Unsuited):
        return line
    if "read-only" in line:
        line += " (it writes into what it is given: work on a copy)"
    return f"{type(error).__name__}: {line}" if line else type(error).__name__


def place_of(error: BaseException, within: str | None = None) -> str:
    """Returns the exception's type, and the file and line where; the last running line of the file
    `within`, if any."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}, line {error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    frame = frames[-1]
    for one in frames:
        if one.filename == within:
            frame = one
    return f"{_shown(frame.filename)}, line {frame.lineno}: {describe_exception(error)}"


def _shown(filename: str) -> str:
    return filename.removeprefix(os.getcwd() + os.sep)


def definition(function: Any) -> str:
    """Returns the file and line in which a function or method is written, if they are known, and
    its name."""
    function = inspect.unwrap(getattr(function, "__func__", function))
    code = getattr(function, "__code__", None)
    name = getattr(function, "__qualname__", str(function))
    if not code:
        return name
    return f"{_shown(code.co_filename)}, line {code.co_firstlineno}: {name}"


def shortened(text: str, length: int = 120) -> str:
    """Returns the text, or its beginning and its end where it is longer than a line."""
    if len(text) <= length:
        return text
    return f"{text[: length - 24]}...{text[-20:]}"


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns the nearest of the known names, capitals or not; empty if none is near."""
    cases = {one.lower(): one for one in known}
    close = difflib.get_close_matches(name.lower(), cases, 1)
    return cases[close[0]] if close else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Returns '; did you mean ...?' with the nearest of the known names; empty if none is near."""
    meant = nearest(name, known)
    return f"; did you mean {meant}?" if meant else ""


ZOO = {
    "accelerometer": "Accelerometer",
    "anderson": "Anderson",
    "bock": "Bock",
    "es_mda": "EsMda",
    "gnss": "Gnss",
    "lm_iekf": "LMIEKF",
    "mgh": "Mgh",
    "multiple_shooting": "MultipleShooting",
    "recursive_update": "RecursiveUpdate",
    "triad": "Triad",
}
"""Options and classes that earlier versions had and the plugin zoo has now."""
RENAMED = {"gins_tilted": "gins_platform_misaligned", "iekf": "iterated_ekf"}
"""Options of earlier versions, and their names now."""


def moved(name: str) -> str:
    """Says where an option or a class of an earlier version is now; empty if it has not moved."""
    if name in RENAMED:
        return f"is {RENAMED[name]} now"
    if name not in (*ZOO, *ZOO.values()):
        return ""
    what = "" if name in ZOO else f"ipe_bench_zoo.{name} "
    place = (
        "in the plugin zoo now; work in a clone of ipe-bench, or `pip install CLONE/plugins/zoo`"
    )
    return f"is {what}{place}"


def unknown(name: str, known: Iterable[str], noun: str) -> str:
    """Says that there is no such option; names the nearest, or else all there are, or where it is
    now."""
    known = sorted(known)
    place = moved(name)
    if place and noun in ("option", "estimator", "group"):
        return place
    listed = f" (there are: {', '.join(known) or 'none'})"
    return f"there is no such {noun}{did_you_mean(name, known) or listed}"


def refuse_unknown(key: str, name: str, known: Collection[str], noun: str) -> None:
    """Raises a UserError about the key unless the name is known."""
    if name not in known:
        raise UserError(f"{key}: {unknown(name, known, noun)}")


def without_modules(room: str, names: Sequence[str]) -> None:
    """Takes a package's modules off its attributes, so that `measurements.gins` is answered with
    the class `Gins`."""
    content = vars(sys.modules[room])
    modules = [name for name, thing in content.items() if isinstance(thing, ModuleType)]
    for name in modules:
        del content[name]

    def missing(name: str) -> Any:
        raise AttributeError(f"{room}.{name}: {moved(name) or unknown(name, names, 'name')}")

    content["__getattr__"] = missing
