"""`ipe-bench bundle DIR...`: results in one archive to share, and `bundle FILE`: whether one is whole."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import places_and_keys, print_problems, say
from ipe_bench.runs.bundles import SUFFIX, Bundle, is_bundle, read_bundle, write_bundle
from ipe_bench.runs.results import Results


def main(arguments: Sequence[str]) -> int:
    """Writes the archive, or checks one; exit code 1 where the folders lack something that was asked for."""
    places, keys = places_and_keys("bundle", arguments, {"output": str})
    paths, output = [Path(place) for place in places], keys.get("output")
    if not paths:
        raise UserError("bundle: name at least one folder of results, such as outputs/paper, or a bundle to check")
    if any(map(is_bundle, paths)):
        if len(paths) > 1 or output:
            raise UserError("bundle: one file is checked by itself; name folders to make a bundle of")
        _show(read_bundle(paths[0]), "Whole")
        return 0
    path = Path(output) if output else paths[0].with_name(paths[0].resolve().name + SUFFIX)
    from ipe_bench.report.definitions import CITATION

    bundle = write_bundle(paths, path.with_name(path.name.removesuffix(SUFFIX) + SUFFIX), {"citation": CITATION})
    problems = Results.read(paths).problems
    print_problems(problems)
    _show(bundle, "Bundle")
    return 1 if problems else 0


def _show(bundle: Bundle, title: str) -> None:
    folders = ", ".join(bundle.folders)
    say(f"{title:<8}{bundle.path} ({len(bundle.files)} files of {folders}; {bundle.size:,} bytes)")
    say(f"Digest  sha256:{bundle.digest}")
