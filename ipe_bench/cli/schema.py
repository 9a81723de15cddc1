"""`ipe-bench schema`: a JSON schema of config files, with which editors complete and check what is written there."""

from __future__ import annotations

import json

from ipe_bench.cli import print_problems
from ipe_bench.cli.spec import keys_of_a_run
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.schema import schema_of


def main() -> int:
    """Prints the schema of the files of all options that there are here, and of experiments."""
    schema, problems = schema_of(plugins.options(), keys_of_a_run())
    print_problems([*plugins.take_problems(), *problems])
    print(json.dumps(schema, indent=2, ensure_ascii=False))
    return 0
