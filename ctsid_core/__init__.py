# SPDX-License-Identifier: Apache-2.0
"""
ctsid: continuous-time state-space models from irregularly sampled signals.

    record = Record.from_arrays(t_u, u, t_y, y)
    estimate = identify(record)
    estimate.model.poles
"""

from importlib import import_module
import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ctsid_core.errors import CtsidError, DataError, SettingsError, StorageError
    from ctsid_core.identify import identify
    from ctsid_core.model.estimate import Choice, Estimate, Status
    from ctsid_core.model.statespace import StateSpace
    from ctsid_core.model.storage import load_model, save_model
    from ctsid_core.model.verdict import Grade, Verdict
    from ctsid_core.settings import Actuator, Settings
    from ctsid_core.signals.record import Record, Signal
    from ctsid_core.signals.windows import SlidingWindow

__all__ = [
    'Actuator', 'Choice', 'CtsidError', 'DataError', 'Estimate', 'Grade', 'Record', 'Settings',
    'SettingsError', 'Signal', 'SlidingWindow', 'StateSpace', 'Status', 'StorageError', 'Verdict',
    'identify', 'load_model', 'save_model',
]
# Each is imported when it is first asked for: `import ctsid_core.errors` needs no SciPy.
_MAKERS = {
    **dict.fromkeys(('CtsidError', 'DataError', 'SettingsError', 'StorageError'), 'errors'),
    'identify': 'identify',
    **dict.fromkeys(('Choice', 'Estimate', 'Status'), 'model.estimate'),
    'StateSpace': 'model.statespace',
    **dict.fromkeys(('load_model', 'save_model'), 'model.storage'),
    **dict.fromkeys(('Grade', 'Verdict'), 'model.verdict'),
    **dict.fromkeys(('Actuator', 'Settings'), 'settings'),
    **dict.fromkeys(('Record', 'Signal'), 'signals.record'),
    'SlidingWindow': 'signals.windows',
}


class _Package(ModuleType):
    """This package: the import of its module `identify` leaves the function of that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if name != 'identify' or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _MAKERS:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value: object = getattr(import_module(f'{__name__}.{_MAKERS[name]}'), name)
    setattr(sys.modules[__name__], name, value)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
