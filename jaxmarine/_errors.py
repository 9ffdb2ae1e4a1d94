"""The one error that a user's input can cause."""


class InputError(ValueError):
    """Something that the user handed in cannot be used.

    The message is one sentence: what is wrong, where, and what to do. The command line prints it
    on stderr without a traceback and ends with exit code 2.
    """
