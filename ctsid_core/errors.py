# SPDX-License-Identifier: Apache-2.0
"""
Exceptions of ctsid.

Misuse raises; poor data do not: they give an `Estimate` with a `Status` and no model. Every
message names what was wrong, the value, and the cure. Each class is also a built-in, so that
callers who know nothing of ctsid still catch it.
"""


class CtsidError(Exception):
    """Base of all errors that ctsid raises on purpose."""


class Cancelled(Exception):  # noqa: N818  # nothing has gone wrong
    """An identification was broken off because its caller said so."""


class DataError(CtsidError, ValueError):
    """Arrays or records that do not fit together."""


class SettingsError(CtsidError, ValueError):
    """
    Parameters of wrong type, unknown, or out of range: all of them at once.

    Parameters
    ----------
    faults : list of str
        One sentence per fault.
    """

    def __init__(self, faults: list[str]) -> None:
        self.faults = tuple(faults)
        count = f'{len(faults)} faults in the parameters:\n  ' if len(faults) > 1 else ''
        super().__init__(count + '\n  '.join(faults))


class StorageError(CtsidError, ValueError):
    """A file that is not what it should be, or of a version this ctsid cannot read."""
