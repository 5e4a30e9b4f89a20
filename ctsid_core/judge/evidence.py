# SPDX-License-Identifier: Apache-2.0
"""What is known about a model when it is judged."""

from __future__ import annotations

from dataclasses import dataclass

from ctsid_core.judge.changed import Change
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.verdict import Verdict
from ctsid_core.signals.stuck import Stuck


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """
    The evidence on a model, for all channels of the record; `numbers` has the rest.

    Parameters
    ----------
    input_names, output_names : tuple of str
    fixed_inputs, fixed_outputs : tuple of int
        Places of the channels that are constant over the window.
    stuck : tuple of Stuck
        Outputs that stop moving within it.
    expected : ndarray, shape (ny,)
        The part of the error on what was held out that the uncertainty of the rest's model lets
        expect, over the motion.
    driven : ndarray, shape (ny,)
        Rms response to the inputs alone, over the motion; 0 if not known.
    poles : ndarray, shape (n,)
    change : Change
    where : str
        Which window, or record, changed, and when.
    worst : str
        Which of several records is explained least.
    by_prediction : bool
        Whether the model was found by its predictions: errors are those of predictions then.
    unproven : bool
        Whether modes grow of which the data do not show that they do.
    numbers : Verdict
        With the numbers that have a place in it.
    """

    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fixed_inputs: tuple[int, ...]
    fixed_outputs: tuple[int, ...]
    stuck: tuple[Stuck, ...]
    expected: Array
    driven: Array
    poles: ComplexArray
    change: Change
    where: str
    worst: str
    numbers: Verdict
    by_prediction: bool = False
    unproven: bool = False

    @property
    def error(self) -> Array:
        """Rms error of the simulation over the motion, (ny,); NaN for constant outputs."""
        return self.numbers.error

    @property
    def coloured(self) -> Array:
        """The part of it that is not white noise, see `Verdict`, (ny,)."""
        return self.numbers.coloured_error

    @property
    def held_out(self) -> Array:
        """Rms error on the part held out, over the motion of the whole window, (ny,)."""
        return self.numbers.held_out_error
