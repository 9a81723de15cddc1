"""The exceptions that are meant for users; everything else that is raised is a bug."""

import math


class UserError(Exception):
    """A mistake in a config, a command or a file: one line that names the key or row, and the remedy.

    The command line prints it without a traceback and exits with code 2.
    """


class StorageError(Exception):
    """Results cannot be stored any more: a full disk, a folder that went away. One line.

    What was stored before is whole. The command line prints it without a traceback and exits with code 1.
    """


def require_positive(component: object, *names: str) -> None:
    """Refuses a field that is no finite number above 0; a field that is None has no limit, or is not used."""
    for name in names:
        value = getattr(component, name)
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"{name}={value}: give a number above 0")


def require_counts(component: object, *names: str, least: int = 1) -> None:
    """Refuses a field that is no whole number of at least `least`."""
    for name in names:
        if getattr(component, name) < least:
            above = "above 0" if least == 1 else f"from {least} up"
            raise UserError(f"{name}={getattr(component, name)}: give a whole number {above}")
