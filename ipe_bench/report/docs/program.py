"""The program itself, run for a page: what a reader would see in a terminal."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence

from ipe_bench.basics.errors import UserError

_STYLE = re.compile(r"\x1b\[[0-9;]*m")


def printed_by(command: Sequence[str], columns: int = 80) -> str:
    """What `ipe-bench COMMAND` prints, without colours and blanks at the ends of lines.

    Raises:
        UserError: it failed.
    """
    program = [sys.executable, "-m", "ipe_bench", *command]
    environment = os.environ | {"COLUMNS": str(columns), "NO_COLOR": "1"}
    done = subprocess.run(program, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        raise UserError(f"{shlex.join(command)}: ended with exit code {done.returncode}: {done.stderr[-2000:]}")
    return "\n".join(line.rstrip() for line in _STYLE.sub("", done.stdout).splitlines())
