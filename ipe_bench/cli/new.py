"""`ipe-bench new KIND NAME`: a working plugin to start from."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.plugins import discovery as plugins

KINDS = ("solver", "baseline", "measurement", "noise")


def main(kind: str, name: str) -> int:
    """Writes plugins/NAME in the working folder."""
    if kind not in KINDS:
        raise UserError(f"{kind}: {unknown(kind, KINDS, 'kind')}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UserError(f"{name}: give a name of small letters, digits and underscores that starts with a letter")
    if keyword.iskeyword(name):
        raise UserError(f"{name}: is a word of Python; choose another name")
    rivals = plugins.ESTIMATOR_GROUPS if kind in plugins.ESTIMATOR_GROUPS else (kind,)
    for option in plugins.options():
        if option.group in rivals and option.name == name:
            raise UserError(
                f"{name}: {option.group}={name} is there already ({option.source.origin}); choose another name"
            )
    folder = Path("plugins") / name
    if folder.exists():
        raise UserError(f"{folder}: is there already and is not overwritten; choose another name")
    package = f"ipe_bench_{name}"
    class_name = "".join(part.title() for part in name.split("_"))
    words = {"kind": kind, "name": name, "package": package, "Class": class_name}
    texts = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{package}/__init__.py": "init.py",
        f"{package}/{name}.py": f"{kind}.py",
        f"{package}/conf/{kind}/{name}.yaml": f"{kind}.yaml",
        f"tests/test_{name}.py": "test.py",
    }
    templates = files("ipe_bench.plugins") / "templates"
    for target, source in texts.items():
        path = folder / target
        path.parent.mkdir(parents=True, exist_ok=True)
        text = (templates / f"{source}.template").read_text(encoding="utf-8")
        path.write_text(Template(text).substitute(words), encoding="utf-8")
    choose = f"{kind}=[{name}]" if kind in ("solver", "baseline") else f"{kind}={name}"
    print(f'{folder} is ready. Try:\n  ipe-bench check {folder}\n  ipe-bench run "{choose}" trials=100')
    return 0
