"""`ipe-bench new KIND NAME`: a working plugin to start from."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli.parser import KINDS
from ipe_bench.plugins import discovery as plugins

LONGEST = 60
RECORDS = {"statistic": "STATISTIC", "figure": "FIGURE", "table": "table", "section": "SECTION"}
"""What reports are made of, and what each is called in its module."""


def main(kind: str, name: str) -> int:
    """Writes plugins/NAME in the working folder."""
    if kind not in KINDS:
        raise UserError(f"{kind}: {unknown(kind, KINDS, 'kind')}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UserError(f"{name}: give a name of small letters, digits and underscores that starts with a letter")
    if len(name) > LONGEST:
        raise UserError(f"{name[:20]}...: give a name of at most {LONGEST} letters")
    if keyword.iskeyword(name):
        raise UserError(f"{name}: is a word of Python; choose another name")
    rivals = plugins.ESTIMATOR_GROUPS if kind in plugins.ESTIMATOR_GROUPS else (kind,)
    for option in plugins.options():
        if option.group in rivals and option.name == name:
            raise UserError(
                f"{name}: {option.group}={name} is there already ({option.source.origin}); choose another name"
            )
    _refuse_column(kind, name)
    folder = Path("plugins") / name
    if folder.exists():
        raise UserError(f"{folder}: is there already and is not overwritten; choose another name")
    package = f"ipe_bench_{name}"
    class_name = "".join(part.title() for part in name.split("_"))
    words = {"kind": kind, "name": name, "package": package, "Class": class_name, "record": RECORDS.get(kind, "")}
    texts = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{package}/__init__.py": "init.py",
        f"{package}/{name}.py": f"{kind}.py",
        f"{package}/conf/{kind}/{name}.yaml": f"{kind}.yaml",
        f"tests/test_{name}.py": "test.py",
    }
    if kind == "experiment":  # it has no class
        texts = {
            "pyproject.toml": "pyproject.toml",
            "README.md": "experiment_readme.md",
            f"{package}/__init__.py": "experiment_init.py",
            f"{package}/conf/experiment/{name}.yaml": "experiment.yaml",
            f"tests/test_{name}.py": "experiment_test.py",
        }
    elif kind in RECORDS:
        own = {"README.md": "record_readme.md", f"{package}/__init__.py": "record_init.py"}
        own |= {f"{package}/conf/{kind}/{name}.yaml": "record.yaml", f"tests/test_{name}.py": "record_test.py"}
        texts |= own
    templates = files("ipe_bench.plugins") / "templates"
    for target, source in texts.items():
        path = folder / target
        path.parent.mkdir(parents=True, exist_ok=True)
        text = (templates / f"{source}.template").read_text(encoding="utf-8")
        path.write_text(Template(text).substitute(words), encoding="utf-8")
    choices = {"solver": f'"solver=[{name}]"', "baseline": f'"baseline=[{name}]"', "experiment": f"+experiment={name}"}
    choose = "" if kind in RECORDS else choices.get(kind, f"{kind}={name}") + " "
    print(f"{folder} is ready. Try:\n  ipe-bench check {folder}\n  ipe-bench run {choose}trials=100")
    return 0


def _refuse_column(kind: str, name: str) -> None:
    """A statistic is a column of the summary, which has ours already."""
    if kind == "statistic":
        from ipe_bench.statistics.records import SCORES, STATISTICS, frame_columns

        if name in frame_columns([*STATISTICS, *SCORES]):
            raise UserError(f"{name}: is a statistic of ours; choose another name")
