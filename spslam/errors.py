"""Exceptions for invalid user input.

Each message is one line that names the file, the option or the argument at fault. Wrong arguments of a function raise
`ValueError` or `TypeError`, as everywhere in Python. The classes here are for what a user provides: configurations,
data, output folders, devices and weights.
"""

_MAX_MESSAGE_CHARACTERS = 900


class SpslamError(Exception):
    """Base class of all errors that a user can fix.

    The message is one line, shortened in the middle where it is very long, whatever a file put into it.
    """

    def __str__(self) -> str:
        text = " ".join(super().__str__().splitlines())
        if len(text) <= _MAX_MESSAGE_CHARACTERS:
            return text
        kept = _MAX_MESSAGE_CHARACTERS // 2 - 3
        return f"{text[:kept]} ... {text[-kept:]}"


class ConfigError(SpslamError):
    """A configuration has an unknown key or a value out of range."""


class DatasetError(SpslamError):
    """A file or a folder of a dataset is missing, unreadable or inconsistent; the message names it."""


class SourceError(SpslamError):
    """A live camera is missing, refuses a setting, or ends unexpectedly."""


class OutputError(SpslamError):
    """A result cannot be written, or the output folder belongs to another run."""


class ClusterError(SpslamError):
    """A cluster can't be reached, or a node of it can't run what it is sent."""


class DeviceError(SpslamError):
    """The requested device is not available, or this build has no kernels for it."""


class WeightsError(SpslamError):
    """A weights file is missing, has tensors of another shape, or is not one of spslam."""


def brief(value: object, most: int = 80) -> str:
    """A value or a name from outside as one short line of a message: its `repr`, cut after `most` characters."""
    text = " ".join((value if isinstance(value, str) else repr(value)).split())
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= most else text[: most - 3] + "..."
