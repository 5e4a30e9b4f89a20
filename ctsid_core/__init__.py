# SPDX-License-Identifier: Apache-2.0
"""
ctsid: continuous-time state-space models from irregularly sampled signals.

    record = Record.from_arrays(t_u, u, t_y, y)
    estimate = identify(record)
    estimate.model.poles
"""

from ctsid_core.errors import CtsidError, DataError, SettingsError, StorageError
from ctsid_core.identify import identify
from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.storage import load_model, save_model
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.signals.windows import SlidingWindow

__all__ = [
    'Choice', 'CtsidError', 'DataError', 'Estimate', 'Grade', 'Record', 'Settings',
    'SettingsError', 'Signal', 'SlidingWindow', 'StateSpace', 'Status', 'StorageError', 'Verdict',
    'identify', 'load_model', 'save_model',
]
