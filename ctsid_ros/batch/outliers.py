# SPDX-License-Identifier: Apache-2.0
"""Bags whose poles are not those of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.sequence.mode_rows import paired
from ctsid_ros.report.tables import number, pole_text

# Bags of which a median and a usual distance from it mean something. If their spread is not that
# of their own standard deviations, a batch of five that are all alike names one in five times,
# of ten or thirty one in ten, of 200 hardly ever (2000 simulated bags of each); else never.
FEWEST = 5
# Standard deviations (of the bags, and the bag's own) that a pole is away from the median. Of
# normal errors one in ten million is, at a pair, and six in 100 000 at a real pole.
FAR = 4.0
# Root mean square of distances over their median, if errors are normal: of pairs, which are in
# the plane, and of real poles.
_PAIR, _REAL = 1.2011, 1.4826


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles of a bag, one of each pair, and their deviations [rad/s]."""

    values: ComplexArray
    std: Array


def outliers(bags: Mapping[str, Poles]) -> dict[str, str]:
    """
    Return which bags have other poles than most, and how they differ.

    Parameters
    ----------
    bags : mapping
        The poles of each bag with an accepted model.
    """
    if len(bags) < FEWEST:
        return {}
    sizes = Counter(len(poles.values) for poles in bags.values())
    usual, count = sizes.most_common(1)[0]
    if count < FEWEST:
        return {}
    found = {name: f'{len(poles.values)} modes, but {usual} in {count} of {len(bags)} bags'
             for name, poles in bags.items() if len(poles.values) != usual}
    alike = {name: poles for name, poles in bags.items() if len(poles.values) == usual}
    return found | _far(alike)


def _far(bags: Mapping[str, Poles]) -> dict[str, str]:
    typical = _typical(list(bags.values()))
    partners = {name: paired(typical, poles.values) for name, poles in bags.items()}
    found: dict[str, str] = {}
    for k, near in enumerate(typical):
        own = {name: poles.values[partners[name][k]] for name, poles in bags.items()
               if k in partners[name]}
        values = np.array(list(own.values()))
        middle = complex(np.median(values.real), np.median(values.imag))
        spread = float(np.median(np.abs(values - middle))) * (_PAIR if middle.imag else _REAL)
        for name, poles in bags.items():
            # Over its size a pole near 0 is far from any other, however little it is known.
            at = partners[name].get(k, int(np.argmin(np.abs(poles.values - middle))))
            away = abs(poles.values[at] - middle)
            std = float(np.hypot(spread, np.nan_to_num(poles.std[at])))
            if away > FAR * std:
                found.setdefault(name, f'no pole near {pole_text(near)} rad/s' if name not in own
                                 else f'pole {pole_text(own[name])} rad/s, '
                                 f'{number(away / max(std, 1e-300), 2)} '
                                 f'standard deviations from the median {pole_text(middle)}')
    return found


def _typical(bags: Sequence[Poles]) -> ComplexArray:
    """Return the poles of a bag that is neither fast nor slow."""
    speeds = [float(np.mean(np.log(np.maximum(np.abs(poles.values), 1e-300)))) for poles in bags]
    return bags[int(np.argsort(speeds)[len(bags) // 2])].values
