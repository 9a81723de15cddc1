"""A covariance of parameters as a user states it: a matrix in the config, or a small file with names in its header.

Whether it is a covariance is left to the prior that it makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.real.readings import Table, read_table

KEY = "prior_covariance"
_NAMES = "parameter"
"""The column of names, where the rows of a file have names too."""


def read_covariance(given: Any, names: Sequence[str]) -> Array:
    """The matrix (n, n) of the parameters `names`, in their order: rows of numbers, or the name of a CSV file.

    A file has a column for every parameter, headed by its name, in any order; its rows are in the order of the columns,
    or have names in a column `parameter`.

    Raises:
        UserError: it is not a matrix of numbers, or of other parameters.
    """
    if isinstance(given, str):
        return _in_file(read_table(Path(given), key=KEY), names)
    if not isinstance(given, list | tuple) or not given or not all(isinstance(row, list | tuple) for row in given):
        raise UserError(f"{KEY}={given}: give a matrix, [[1,0.5],[0.5,1]], or a CSV file")
    for i, row in enumerate(given):
        if len(row) != len(given):
            raise UserError(f"{KEY}: row {i + 1} has {len(row)} numbers and there are {len(given)} rows")
        for value in row:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise UserError(f"{KEY}: row {i + 1} has '{value}', which is not a number")
    return np.array(given, dtype=float)


def _in_file(table: Table, names: Sequence[str]) -> Array:
    headings = [name for name in table.heading if name != _NAMES]
    for name in headings:
        if name not in names:
            raise table.error(f"column {name}: {unknown(name, names, 'parameter that is estimated')}")
    for name in names:
        if name not in headings:
            raise table.error(f"has no column {name}; every parameter that is estimated has one")
    rows = headings
    if _NAMES in table.heading:
        rows = [text.strip() for text, _ in table.column(_NAMES)]
        for name, (_, where) in zip(rows, table.column(_NAMES), strict=True):
            if name not in names or rows.count(name) > 1:
                raise table.error(f"{where}: '{name}' is not the name of one parameter, once")
    if len(table.rows) != len(names):
        raise table.error(f"has {len(table.rows)} rows and {len(headings)} parameters; give a row for each")
    found = np.empty((len(names), len(names)))
    for name in headings:
        for row, (text, where) in zip(rows, table.column(name), strict=True):
            if not text.strip():
                raise table.error(f"{where}: is empty; give 0 where two do not depend on each other")
            found[names.index(row), names.index(name)] = table.value(text, where)
    return found
