"""The one exception that stands for a user's mistake; everything else that is raised is a bug."""


class UserError(Exception):
    """A mistake in a config, a command or a file: one line that names the key or row, and the remedy.

    The command line prints it without a traceback and exits with code 2.
    """
