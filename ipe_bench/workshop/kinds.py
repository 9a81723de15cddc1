"""Names the kinds of plugins and models that `ipe-bench new` makes."""

from __future__ import annotations

MODELS = ("function", "ode")
"""Models of one file."""
KINDS = ("solver", "baseline", "filter", "measurement", "state_model", "tracker", "noise", "prior")
KINDS += ("execution", "statistic", "figure", "table", "section", "experiment")
"""Of plugins that `new` makes."""


RECORDS = {"statistic": "STATISTIC", "figure": "FIGURE", "table": "table", "section": "SECTION"}
"""Names of the elements of reports, and of each in its module."""
