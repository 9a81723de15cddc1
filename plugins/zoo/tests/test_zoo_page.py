"""The page of the zoo names what there is, and its lines run."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ZOO = Path(__file__).parents[1]
PAGE = (ZOO / "README.md").read_text(encoding="utf-8")
LINES = PAGE.partition("## Run them")[2].partition("## ")[0]
COMMANDS = [
    line.removeprefix("    ipe-bench ")
    for line in LINES.splitlines()
    if line.startswith("    ipe-bench ")
]


def test_its_tables_name_all_that_there_is():
    named = re.findall(
        r"^\| `\+?(measurement|state_model|baseline|experiment)=\[?(\w+)\]?`", PAGE, re.MULTILINE
    )
    there = [
        path.relative_to(ZOO / "ipe_bench_zoo/conf").with_suffix("").parts
        for path in ZOO.rglob("conf/*/*.yaml")
    ]
    kinds = ("measurement", "state_model", "baseline", "experiment")
    assert set(named) == {one for one in there if one[0] in kinds}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_its_lines_run(command, tmp_path):
    (tmp_path / "plugins").symlink_to(ZOO.parent)
    environment = os.environ | {"NO_COLOR": "1"}
    program = [sys.executable, "-m", "ipe_bench", *shlex.split(command)]
    done = subprocess.run(
        program, cwd=tmp_path, capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
