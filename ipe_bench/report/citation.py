"""How results of the bench are cited: the same words on the page and beside a bundle."""

from __future__ import annotations

from ipe_bench import __version__

CITATION = (
    f"The ipe-bench developers (2026). ipe-bench, version {__version__} [computer program]. Beside it, state the"
    " command, the git commit and the source's digest that stand with the provenance, and the digest of the bundle"
    " where results are shared as one (`ipe-bench bundle`)."
)
