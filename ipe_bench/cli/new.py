"""`ipe-bench new KIND NAME`: a working plugin to start from."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli.parser import KINDS, MODELS
from ipe_bench.plugins import discovery as plugins

LONGEST = 60
RECORDS = {"statistic": "STATISTIC", "figure": "FIGURE", "table": "table", "section": "SECTION"}
"""What reports are made of, and what each is called in its module."""
ALONE = {
    "function": (
        "{name}.py",
        'measurement=function measurement.of={name}:{name} "measurement.columns.t=[0,1,2,3,4]"',
    ),
    "ode": ("{name}.yaml", "measurement=ode measurement.file={name}.yaml"),
}
"""Models that are one file and no plugin, and how to choose them."""


def main(kind: str, name: str) -> int:
    """Writes plugins/NAME in the working folder, or the one file of a function or of differential equations."""
    if kind == "skill":
        from ipe_bench.cli.skill import write_skill

        files = write_skill(Path(name))
        print(f"{name} is ready: {', '.join(path.name for path in files)}")
        return 0
    if kind not in (*MODELS, *KINDS):
        raise UserError(f"{kind}: {unknown(kind, (*MODELS, *KINDS, 'skill'), 'kind')}")
    group = "baseline" if kind == "filter" else kind
    _check_name(group, name)
    if kind in ALONE:
        file, choice = (text.format(name=name) for text in ALONE[kind])
        if Path(file).exists():
            raise UserError(f"{file}: is there already and is not overwritten; choose another name")
        _fill(Path(file), f"{kind}{Path(file).suffix}", {"name": name})
        noise = "noise=gaussian noise.deviation=0.01 " if kind == "function" else ""
        print(f"{file} is ready. Try:\n  ipe-bench check {choice}")
        print(f"  ipe-bench run {choice} {noise}error_scale=0.1 trials=100")
        return 0
    folder, package = Path("plugins") / name, f"ipe_bench_{name}"
    if folder.exists():
        raise UserError(f"{folder}: is there already and is not overwritten; choose another name")
    class_name = "".join(part.title() for part in name.split("_"))
    words = {"kind": kind, "name": name, "package": package, "Class": class_name, "record": RECORDS.get(kind, "")}
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
        _fill(folder / target, source, words)
    choices = {"solver": f'"solver=[{name}]"', "baseline": f'"baseline=[{name}]"', "experiment": f"+experiment={name}"}
    choose = "" if kind in RECORDS else choices.get(group, f"{group}={name}") + " "
    choose = "figures=all " if kind == "figure" else choose  # the figures of main are chosen among our own
    print(f"{folder} is ready. Try:\n  ipe-bench check {folder}\n  ipe-bench run {choose}trials=100")
    return 0


def _fill(path: Path, source: str, words: Mapping[str, str]) -> None:
    """Writes a file from its template."""
    path.parent.mkdir(parents=True, exist_ok=True)
    template = files("ipe_bench.plugins") / "templates" / f"{source}.template"
    path.write_text(Template(template.read_text(encoding="utf-8")).substitute(words), encoding="utf-8")


def _check_name(kind: str, name: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UserError(f"{name}: give a name of small letters, digits and underscores that starts with a letter")
    if len(name) > LONGEST:
        raise UserError(f"{name[:20]}...: give a name of at most {LONGEST} letters")
    if keyword.iskeyword(name):
        raise UserError(f"{name}: is a word of Python; choose another name")
    rivals = plugins.ESTIMATOR_GROUPS if kind in plugins.ESTIMATOR_GROUPS else (kind,)
    for option in plugins.options():
        if option.group in rivals and option.name == name:
            origin = option.source.origin
            raise UserError(f"{name}: {option.group}={name} is there already ({origin}); choose another name")
    if kind == "statistic":  # a column of the summary
        from ipe_bench.statistics.records import SCORES, STATISTICS, frame_columns

        if name in frame_columns([*STATISTICS, *SCORES]):
            raise UserError(f"{name}: is a statistic of ours; choose another name")
