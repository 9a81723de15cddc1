"""The exceptions that are meant for users; everything else that is raised is a bug."""


class UserError(Exception):
    """A mistake in a config, a command or a file: one line that names the key or row, and the remedy.

    The command line prints it without a traceback and exits with code 2.
    """


class StorageError(Exception):
    """Results cannot be stored any more: a full disk, a folder that went away. One line.

    What was stored before is whole. The command line prints it without a traceback and exits with code 1.
    """
