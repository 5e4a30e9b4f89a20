# SPDX-License-Identifier: Apache-2.0
"""Whether a second method, which has little in common with the first, finds the same model."""

from __future__ import annotations

from dataclasses import dataclass
import math

UNKNOWN = 'cannot tell'     # whether a second method agrees


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
