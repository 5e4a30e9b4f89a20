# SPDX-License-Identifier: Apache-2.0
"""
Whether an estimate may be used: one word, one sentence, and the numbers behind them.

The word follows from the numbers by the rules of `judge/rules.py`; `docs/glossary.md` says what
each number means, `docs/verdict.md` where each threshold was measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.cross_check_result import Agreement

EXPLAINED = 30.0        # fit [%] below which an output counts as not explained


class Grade(Enum):
    """How far an estimate may be trusted; the value says it in a sentence."""

    GOOD = 'Every test is passed: use the model.'
    WEAK = 'The model is shown, but something about it is not known well enough to act on it.'
    REJECT = 'There is no model, or it is wrong.'


@dataclass(frozen=True)
class Excitation:
    """
    How one input excites the plant, and how well the response to it is determined.

    Parameters
    ----------
    name : str
        Of the input.
    low, high : float
        Excited band [rad/s]: its ends. In it the response to the part of this input that is not
        correlated with other inputs exceeds the noise; NaN if it does nowhere.
    frequencies : float
        Effective number of frequencies, as far as the window resolves them; one sine is 1.
    own : float
        Uncorrelated part: share of its power that is not correlated with other inputs, 0 to 1.
    uncertainty : float
        Standard deviation of the response to it, over the response, rms; above 1 nothing is
        known.
    """

    name: str
    low: float = float('nan')
    high: float = float('nan')
    frequencies: float = 0.0
    own: float = 0.0
    uncertainty: float = float('inf')


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """
    A grade, the reason, and the numbers behind it; NaN or empty where not known.

    Parameters
    ----------
    grade : Grade
    reason : str
        One sentence: what is wrong and what to do.
    excitation : tuple of Excitation
        Of each input.
    pole_uncertainty : float
        Largest standard deviation of a pole over its size, or over the frequency that the
        window resolves if that is larger.
    missing : ndarray, shape (ny,)
        Unmodelled response: the part of the prediction errors of each output that past inputs
        explain, over the response to the inputs, rms.
    missing_p_value : ndarray, shape (ny,)
        P-value of 'the prediction errors do not depend on past inputs'.
    whiteness : ndarray, shape (ny,)
        P-value of 'the prediction errors are white'.
    next_ratio : ndarray, shape (ny,)
        Held-out error ratio: power of the errors of a model of the first part of the window on
        the held-out part, over the power of the model's own errors.
    fresh_ratio : ndarray, shape (ny,)
        Fresh error ratio: rms error of the previous model on the data that are new in this
        window, over that on the older data of this window.
    moved : float
        Largest movement of a pole since the previous model, in standard deviations of both
        together; NaN if the orders differ or there was none.
    agreement : Agreement or None
        With a second method; None if none was asked for.
    """

    grade: Grade
    reason: str
    excitation: tuple[Excitation, ...] = ()
    pole_uncertainty: float = float('nan')
    missing: Array = field(default_factory=lambda: np.empty(0))
    missing_p_value: Array = field(default_factory=lambda: np.empty(0))
    whiteness: Array = field(default_factory=lambda: np.empty(0))
    next_ratio: Array = field(default_factory=lambda: np.empty(0))
    fresh_ratio: Array = field(default_factory=lambda: np.empty(0))
    moved: float = float('nan')
    agreement: Agreement | None = None


UNJUDGED = Verdict(grade=Grade.WEAK, reason='Nobody has judged this model; test it on data that '
                   'it has not seen before using it.')
