"""`ipe-bench check PLUGIN`: whether a plugin keeps the promises that every component makes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import Finding, check_component
from ipe_bench.plugins.construct import construct

_COMPONENT_GROUPS = ("measurement", "noise", "prior", *plugins.ESTIMATOR_GROUPS)


def main(folders: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders; exit code 1 where a check fails."""
    if not folders:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise UserError(f"{folder}: there is no such folder")
        if not plugins.add_folder(folder):
            raise UserError(f"{folder}: holds no package with a folder conf in it; see `ipe-bench new`")
    failed = 0
    for folder in map(Path, folders):
        failed += _check_plugin(folder)
    return 1 if failed else 0


def _check_plugin(folder: Path) -> int:
    out = console()
    failed = 0
    for option in plugins.options():
        if not option.path.is_relative_to(folder.resolve()) or option.group not in _COMPONENT_GROUPS:
            continue
        name = f"{option.group}={option.name}"
        config = OmegaConf.to_container(OmegaConf.load(option.path), resolve=True)
        for finding in check_component(name, construct(config, option.package or option.group)):
            failed += bool(finding.complaint)
            out.print(_line(finding), markup=False, soft_wrap=True)
    out.print(f"{folder}: {failed} checks failed" if failed else f"{folder}: all checks passed", markup=False)
    return failed


def _line(finding: Finding) -> str:
    verdict = "FAILED" if finding.complaint else "ok"
    return f"{verdict:7}{finding.component}: {finding.check}" + (
        f" -- {finding.complaint}" if finding.complaint else ""
    )
