# SPDX-License-Identifier: Apache-2.0
"""What a report says of dead times: given, found, or not looked for."""

from __future__ import annotations

from ctsid_core.model.estimate import Estimate
from ctsid_core.settings import Settings
from ctsid_core.subspace.methods import METHODS
from ctsid_ros.config.channels import Config
from ctsid_ros.report.tables import plus_minus


def looked_for(estimate: Estimate, settings: Settings) -> bool:
    """
    Return whether dead times that were not given have been looked for.

    Parameters
    ----------
    estimate : Estimate
    settings : Settings
        As given: those of the estimate have its dead times filled in.
    """
    model = estimate.model or estimate.rejected_model
    return (model is not None and any(settings.unknown_delays(model.nu))
            and METHODS[settings.method].refines and settings.refine)


def delay_words(estimate: Estimate, config: Config) -> dict[str, str]:
    """Return the dead time of each input channel as words [s]."""
    model = estimate.model or estimate.rejected_model
    if model is None:
        return {}
    how = 'found' if looked_for(estimate, config.settings) else 'not looked for'
    words, first = {}, 0
    for channel in config.inputs:
        own = slice(first, first + channel.width)
        first += channel.width
        listed = ', '.join(plus_minus(*one, 3) for one in zip(
            model.delay[own], estimate.delay_std[own].tolist(), strict=True))
        words[channel.name] = f'{listed} ({how})' if isinstance(channel.delay, str) else listed
    return words
