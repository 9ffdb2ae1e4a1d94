"""The one error that a user's input can cause, and what several commands say with it."""


class InputError(ValueError):
    """Something that the user handed in cannot be used.

    The message is one sentence: what is wrong, where, and what to do. The command line prints it
    on stderr without a traceback and ends with exit code 2.
    """


def runaway(log: str, vehicle: str) -> InputError:
    """What to say where the simulation of a vehicle does not stay finite along a log."""
    return InputError(
        f"{log}: the simulation of {vehicle} runs away on it; check the signs of damping and added mass."
    )
