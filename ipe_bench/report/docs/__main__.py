"""`python -m ipe_bench.report.docs [OUTPUT] [--trials N]`: builds the site of written and generated pages by Sphinx."""

from __future__ import annotations

import argparse
import shutil
import sys
from importlib.metadata import version
from importlib.resources import as_file, files
from pathlib import Path

from ipe_bench.report.docs.generated import write_gallery, write_reference

SETTINGS = {
    "project": "ipe-bench",
    "version": version("ipe-bench"),
    "release": version("ipe-bench"),
    "copyright": "the authors of ipe-bench",
    "extensions": ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "ipe_bench.report.docs"],
    "myst_enable_extensions": ["attrs_inline", "dollarmath", "deflist", "colon_fence"],
    "myst_heading_anchors": 3,
    "nb_execution_mode": "force",
    "nb_execution_in_temp": True,
    "nb_execution_raise_on_error": True,
    "nb_execution_timeout": 120,
    "html_theme": "pydata_sphinx_theme",
    "html_title": "ipe-bench",
    "html_show_sourcelink": False,
    "html_math_renderer": "mathml",
    "html_theme_options": {
        "show_prev_next": False,
        "navigation_with_keys": False,
        "secondary_sidebar_items": ["page-toc"],
    },
    "autodoc_typehints": "none",
    "autodoc_member_order": "bysource",
}
"""Sphinx's; nothing that a page needs is fetched when it is opened."""


def build(output: Path, trials: int) -> int:
    """Writes the site to OUTPUT/html and what it is made of beside it; returns Sphinx's exit code.

    Experiments that were run before with as many trials are not run again.
    """
    from sphinx.application import Sphinx  # pyright: ignore[reportMissingImports]

    source = output / "source"
    shutil.rmtree(source, ignore_errors=True)
    with as_file(files("ipe_bench.report.docs") / "pages") as pages:
        shutil.copytree(pages, source)
    print("reference pages ...", flush=True)
    write_reference(source / "reference")
    write_gallery(source / "gallery", output / "results", trials)
    places = (output / "html", output / "doctrees")
    site = Sphinx(source, None, *places, "html", SETTINGS, warningiserror=True, freshenv=True)
    site.build()
    return site.statuscode


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", default="outputs/docs", type=Path)
    parser.add_argument("--trials", type=int, default=10, help="of an experiment that has 1000 by itself")
    arguments = parser.parse_args()
    sys.exit(build(arguments.output, arguments.trials))
