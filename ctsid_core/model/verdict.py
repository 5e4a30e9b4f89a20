# SPDX-License-Identifier: Apache-2.0
"""
Whether an estimate may be used: one word, one sentence, and the numbers behind them.

The word follows from the numbers by the rules of `judge/rules.py`; `docs/glossary.md` says what
each number means, `docs/verdict.md` where each threshold was measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
import math

import numpy as np

from ctsid_core.linear.types import Array

UNKNOWN = 'cannot tell'     # whether a second method agrees
EXPLAINED = 30.0        # fit [%] below which an output counts as not explained


class Grade(Enum):
    """How far an estimate may be trusted; the value says it in a sentence."""

    GOOD = 'Every test is passed: use the model.'
    WEAK = 'The model is shown, but something about it is not known well enough to act on it.'
    REJECT = 'There is no model, or it is wrong.'


class Remedy(Enum):
    """What to try next; the value says it in a clause. A reason ends with what that is here."""

    TEST = 'test the model on data that it has not seen'
    EXCITE = 'move the inputs otherwise'
    SIGNALS = 'look at the signals'
    PART = 'take a part of the data without that'
    SPLIT = 'identify each side of the change by itself'
    LONGER = 'take a longer window'
    SETTING = 'change the setting that is named'
    RECORD = 'take or record the samples as is said'
    COMPARE = 'compare the methods'
    WAIT = 'wait until that has left the window'


@dataclass(frozen=True)
class Excitation:
    """How one input excites the plant, and how well the response to it is determined."""

    name: str
    # Excited band [rad/s]: all but 2 % of the response to this input, differenced, lies in it
    low: float = float('nan')
    high: float = float('nan')
    # Effective number of frequencies of its differences, every octave alike, as far as the window
    # resolves them; one sine has about 1
    frequencies: float = 0.0
    own: float = 0.0        # share of its power that is not correlated with other inputs, 0 to 1
    # Standard deviation of the frequency response to it, over the response, averaged with the
    # power of the differenced response; above 1 nothing is known
    uncertainty: float = float('inf')


@dataclass(frozen=True)
class Agreement:
    """The largest difference between the model and that of a second method."""

    method: str
    # `difference` and `difference_std` are both within what the verdict allows for the response to
    # an input (12 %), and nothing contradicts. Where deviations are too large to tell, or nothing
    # can be compared, neither this nor `contradicts` is true.
    agrees: bool
    # It has no model, or this differs at a frequency by more than 5 % and by more than 3 standard
    # deviations (2 if the second method is hd-pbsid), or it has a dead time that the model lacks.
    # Deviations that are not known excuse nothing: more than 5 % is enough, less is neither.
    contradicts: bool
    # Difference of the frequency responses over the response, rms, of the model within the band
    # that the input excites: the largest of those beyond both limits, or of all if there are none;
    # NaN if there is nothing to compare.
    relative: float = float('nan')
    deviations: float = float('nan')    # the same in standard deviations of both models together
    input: str = ''                     # of whose response
    frequency: float = float('nan')     # where that is [rad/s]
    # As `relative`, but rms over the band, every octave alike: the largest of those beyond 12 %
    # and 3 standard deviations; else of the input for which this and its deviation are largest.
    difference: float = float('nan')
    difference_std: float = float('nan')    # of both models together
    late: str = ''                      # input found to act later by more than 3 deviations
    dead_time: float = 0.0              # how much later [s]
    problem: str = ''                   # why there is no second model, or no comparison

    @property
    def answer(self) -> str:
        """Yes, no, or cannot tell: whether the second method agrees."""
        return 'yes' if self.agrees else 'no' if self.contradicts else UNKNOWN

    @property
    def weakness(self) -> str:
        """What is wrong and what to do; empty unless the methods contradict each other."""
        if not self.contradicts:
            return ''
        if self.problem:
            found = self.problem.removesuffix('.')
            return f'The cross-check by {self.method} failed: {found}; compare the methods.'
        if self.late:
            return (f'Another method, {self.method}, finds that input {self.late} acts '
                    f'{self._late}; set its `delay`.')
        return f'Another method, {self.method}, {self._differs}; compare the methods.'

    @property
    def words(self) -> str:
        """The outcome in a sentence."""
        if self.problem:
            return self.weakness or f'{self.method} cannot be compared: {self.problem}'
        if not self.contradicts:
            return f'{self.method} {"agrees" if self.agrees else UNKNOWN}: {self._within}.'
        late = f', and finds that input {self.late} acts {self._late}' if self.late else ''
        return f'{self.method} does not agree: it {self._differs}{late}.'

    @property
    def _within(self) -> str:
        if math.isnan(self.difference):
            return 'by how much it differs over the excited band is not known'
        differs = f'over the excited band it differs by {100 * self.difference:.2g} % of the ' \
            'response'
        if math.isnan(self.difference_std):
            return f'{differs}, but standard deviations are not known'
        return f'{differs}, with a standard deviation of {100 * self.difference_std:.2g} %'

    @property
    def _late(self) -> str:
        return f'{abs(self.dead_time):.3g} s {"later" if self.dead_time > 0.0 else "earlier"}'

    @property
    def _differs(self) -> str:
        sure = '' if math.isnan(self.deviations) else \
            f', {self.deviations:.2g} standard deviations'
        return (f'differs by {100 * self.relative:.2g} % of the response to {self.input} at '
                f'{self.frequency:.3g} rad/s{sure}')


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """
    A grade, the reason, and the numbers behind it; NaN or empty where not known.

    Parameters
    ----------
    grade : Grade
    reason : str
        One sentence: what is wrong and what to do.
    remedy : Remedy
        The kind of that.
    excitation : tuple of Excitation
        Of each input.
    pole_uncertainty : float
        Largest standard deviation of a pole over its size, or over 1 / duration if that is
        larger.
    whiteness : ndarray, shape (ny,)
        P-value of 'the prediction errors are white'.
    response_uncertainty : ndarray, shape (ny,)
        Standard deviation of the frequency response of each output to all inputs, over the
        response, likewise averaged.
    error : ndarray, shape (ny,)
        Rms error of the simulation over the motion of each output; the fit is 1 less that.
    coloured_error : ndarray, shape (ny,)
        The part of it that is not white noise: model errors and disturbances. Of predictions the
        error, or that part over what the output moves by in the time that they are ahead.
    held_out_error : ndarray, shape (ny,)
        Rms error of a model of the rest of the window on what was held out, over the motion of the
        whole window.
    independent : ndarray, shape (ny,)
        Share of independent samples among the errors, N_eff / N: 1 if they are white.
    change_cost : float
        Rms of what one model misses and two models, before and after the instant at which they
        gain most, do not, over the motion [%].
    curve_gain : ndarray, shape (ny,)
        Points of fit that squares and cubes of the inputs and of the simulated outputs gain beside
        the model, of the motion within a tenth of a record [%].
    fresh_ratio : ndarray, shape (ny,)
        Fresh error ratio: rms error of the previous model on the data that are new in this
        window (the last tenth, if less is new), its mean apart, over that on the worst stretch as
        long of its older data; or, if there is none, over that on the model's own window.
    apart : ndarray, shape (ny,)
        Rms difference of what this model and the previous one simulate of the window, over the
        motion; NaN if there was none, or either was found by predictions.
    agreement : Agreement or None
        With a second method; None if none was asked for.
    """

    grade: Grade
    reason: str
    remedy: Remedy = Remedy.TEST
    excitation: tuple[Excitation, ...] = ()
    pole_uncertainty: float = float('nan')
    whiteness: Array = field(default_factory=lambda: np.empty(0))
    response_uncertainty: Array = field(default_factory=lambda: np.empty(0))
    error: Array = field(default_factory=lambda: np.empty(0))
    coloured_error: Array = field(default_factory=lambda: np.empty(0))
    held_out_error: Array = field(default_factory=lambda: np.empty(0))
    independent: Array = field(default_factory=lambda: np.empty(0))
    change_cost: float = float('nan')
    curve_gain: Array = field(default_factory=lambda: np.empty(0))
    fresh_ratio: Array = field(default_factory=lambda: np.empty(0))
    apart: Array = field(default_factory=lambda: np.empty(0))
    agreement: Agreement | None = None


UNJUDGED = Verdict(grade=Grade.WEAK, reason='Nobody has judged this model; test it on data that '
                   'it has not seen.')
