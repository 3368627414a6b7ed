"""The errors spslam raises for input it can't work with.

Each message is one line that names the file, the option or the argument at fault. Wrong arguments of a
function are ``ValueError`` or ``TypeError``, as everywhere in Python; the classes here are for what a user
brings: configurations, data, output folders, devices and weights.
"""


class SpslamError(Exception):
    """Root of every error that a user can put right."""


class ConfigError(SpslamError):
    """A configuration has an unknown key or a value out of its range."""


class DatasetError(SpslamError):
    """A file or a folder of a dataset is missing, unreadable or inconsistent; the message names it."""


class OutputError(SpslamError):
    """A result can't be written, or the output folder belongs to another run."""


class DeviceError(SpslamError):
    """The device asked for isn't there, or this build has no kernels for it."""


class WeightsError(SpslamError):
    """A file of weights is missing, of another shape, or not one of ours."""


def brief(value: object, most: int = 80) -> str:
    """A value or a name from outside as one short line of a message: its `repr`, cut after `most` characters."""
    text = " ".join((value if isinstance(value, str) else repr(value)).split())
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= most else text[: most - 3] + "..."
