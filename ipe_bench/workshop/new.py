"""Writes plugins and models to start from, out of templates."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.machine import library_versions
from ipe_bench.plugins import discovery as plugins
from ipe_bench.workshop.kinds import KINDS, MODELS, RECORDS

ALONE = {
    "function": (
        "{name}.py",
        'measurement=function measurement.of={name}:{name} "measurement.columns.t=[0,1,2,3,4]"',
    ),
    "ode": ("{name}.yaml", "measurement=ode measurement.file={name}.yaml"),
}
"""Models that are one file and no plugin, and how to choose them."""


def new(kind: str, name: str, language: str | None = None) -> str:
    """Writes plugins/NAME in the working folder, or the file of a model; returns what to try
    next."""
    added = plugins.kinds_to_copy()
    if kind in added:
        return copy_kind(kind, added[kind], name, language)
    if language is not None and kind in (*MODELS, *KINDS, "skill", "ci"):
        raise UserError(f"--language={language}: {kind} has no languages; leave it out")
    if kind not in (*MODELS, *KINDS):
        hint = "; `pip install plugins/process` in a checkout adds it" if kind == "process" else ""
        raise UserError(
            f"{kind}: {unknown(kind, (*MODELS, *KINDS, *added, 'skill', 'ci'), 'kind')}{hint}"
        )
    group = "baseline" if kind == "filter" else kind
    _check_name(group, name)
    if kind in ALONE:
        return _new_file(kind, name)
    folder = Path("plugins") / name
    package = f"ipe_bench_{name}"
    require_absent(folder)
    class_name = "".join(part.title() for part in name.split("_"))
    words = {
        "kind": kind,
        "name": name,
        "package": package,
        "Class": class_name,
        "record": RECORDS.get(kind, ""),
    }
    family = "record_" if kind in RECORDS else "experiment_" if kind == "experiment" else ""
    texts = {
        "pyproject.toml": "pyproject.toml",
        "README.md": f"{family}readme.md" if family else "README.md",
        f"{package}/__init__.py": f"{family}init.py",
        f"{package}/{name}.py": f"{kind}.py",
        f"{package}/conf/{group}/{name}.yaml": "record.yaml" if kind in RECORDS else f"{kind}.yaml",
        f"tests/test_{name}.py": f"{family}test.py",
    }
    if kind == "experiment":  # it has no class
        del texts[f"{package}/{name}.py"]
    for target, source in texts.items():
        fill(folder / target, source, words)
    tried = f"ipe-bench run {_choice(group, name)}trials=100"
    return f"{folder} is ready. Try:\n  ipe-bench check {folder}\n  {tried}"


def _choice(group: str, name: str) -> str:
    """Returns the words by which a run takes the option."""
    choices = {"solver": f'"solver=[{name}]" ', "baseline": f'"baseline=[{name}]" '}
    choices |= {"experiment": f"+experiment={name} ", **dict.fromkeys(RECORDS, "")}
    choices["tracker"] = f'state_model=pendulum "tracker=[{name}]" '
    choices["figure"] = "figures=all "  # the figures of main are chosen among our own
    return choices.get(group, f"{group}={name} ")


def _new_file(kind: str, name: str) -> str:
    """Writes a model that is one file."""
    file, choice = (text.format(name=name) for text in ALONE[kind])
    path = Path(file)
    require_absent(path)
    fill(path, f"{kind}{path.suffix}", {"name": name})
    noise = "noise=gaussian noise.deviation=0.01 " if kind == "function" else ""
    tried = f"ipe-bench run {choice} {noise}error_scale=0.1 trials=100"
    return f"{file} is ready. Try:\n  ipe-bench check {choice}\n  {tried}"


def copy_kind(kind: str, home: Path, name: str, language: str | None) -> str:
    """Copies the files of a plugin's kind, and those of one of its languages, into plugins/NAME;
    returns what to read."""
    languages = sorted(path.name.removeprefix(f"{kind}-") for path in home.glob(f"{kind}-*"))
    if languages and language not in languages:
        why = "is not given" if language is None else unknown(language, languages, "language")
        raise UserError(f"--language={language or ''}: {why}; choose one of {', '.join(languages)}")
    sources = [home / kind]
    if languages:
        sources.append(home / f"{kind}-{language}")
    texts = {}
    for source in sources:
        for path in source.rglob("*"):
            if path.is_file():
                texts[path] = path.relative_to(source)
    # The group is the folder of its config.
    groups = (place.parts[2] for place in texts.values() if place.parts[1:2] == ("conf",))
    group = next(groups, kind)
    _check_name(group, name)
    folder = Path("plugins") / name
    require_absent(folder)
    for path, place in texts.items():
        target = folder / str(place).replace("NAME", name).removesuffix(".template")
        target.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text(encoding="utf-8")
        filled = Template(text).substitute(name=name) if path.suffix == ".template" else text
        target.write_text(filled, encoding="utf-8")
    return f"{folder} is ready. Read {folder / 'README.md'}"


def require_absent(path: Path) -> None:
    if path.exists():
        raise UserError(f"{path}: is there already and is not overwritten; choose another name")


def fill(path: Path, source: str, words: Mapping[str, str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    template = files("ipe_bench.workshop") / "templates" / f"{source}.template"
    text = Template(template.read_text(encoding="utf-8"))
    path.write_text(text.substitute(words), encoding="utf-8")


def _check_name(group: str, name: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]{,59}", name):
        raise UserError(
            f"{name[:80]}: give a name of at most 60 small letters, digits and underscores that"
            " starts with a letter"
        )
    if keyword.iskeyword(name):
        raise UserError(f"{name}: is a word of Python; choose another name")
    if name in ("ipe_bench", *library_versions()):
        raise UserError(f"{name}: is a package that ipe-bench imports; choose another name")
    if re.fullmatch("con|prn|aux|nul|(com|lpt)[0-9]", name):
        raise UserError(f"{name}: is no name of a folder on Windows; choose another name")
    rivals = plugins.ESTIMATOR_GROUPS if group in plugins.ESTIMATOR_GROUPS else (group,)
    for option in plugins.options():
        if option.group in rivals and option.name == name:
            origin = option.source.origin
            raise UserError(
                f"{name}: {option.group}={name} is there already ({origin}); choose another name"
            )
