# SPDX-License-Identifier: Apache-2.0
"""Bags whose poles or gains are not those of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.sequence.alignment import paired
from ctsid_ros.report.tables import number, pole_text

# Bags of which a median and a usual distance from it mean something. If their spread is ten times
# their own standard deviations, of one pole and one gain a batch of five that are all alike names
# one in three times, of ten one in seven, of 30 or 200 one in 20 (300 simulated batches and more);
# if it is that of these deviations, never.
FEWEST = 5
# Standard deviations (of the bags, and the bag's own) that a pole is away from the median. Of
# normal errors one in ten million is, at a pair, and six in 100 000 at a real pole.
FAR = 4.0
# Root mean square of distances over their median, if errors are normal: of pairs, which are in
# the plane, and of real poles.
_PAIR, _REAL = 1.2011, 1.4826


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers of a bag's model: poles, one of each pair, their deviations [rad/s], and gains."""

    poles: ComplexArray
    std: Array
    # by what they are of, with their deviations; NaN: not known
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def outliers(bags: Mapping[str, Numbers]) -> dict[str, str]:
    """
    Return which bags have other poles or gains than most, and how they differ.

    Parameters
    ----------
    bags : mapping
        The numbers of each bag with an accepted model.
    """
    if len(bags) < FEWEST:
        return {}
    sizes = Counter(len(own.poles) for own in bags.values())
    usual, count = sizes.most_common(1)[0]
    if count < FEWEST:
        return {}
    found = {name: f'{len(own.poles)} modes, but {usual} in {count} of {len(bags)} bags'
             for name, own in bags.items() if len(own.poles) != usual}
    alike = {name: own for name, own in bags.items() if len(own.poles) == usual}
    return found | _other_gains(alike) | _other_poles(alike)


def _other_gains(bags: Mapping[str, Numbers]) -> dict[str, str]:
    found: dict[str, str] = {}
    for path in dict.fromkeys(path for numbers in bags.values() for path in numbers.gains):
        own = {name: numbers.gains[path] for name, numbers in bags.items()
               if np.isfinite(numbers.gains.get(path, (np.nan,))[0])}
        if len(own) < FEWEST:
            continue
        values = np.array([value for value, _ in own.values()])
        middle = float(np.median(values))
        spread = float(np.median(np.abs(values - middle))) * _REAL
        for name, (value, std) in own.items():
            if far := _far(abs(value - middle), spread, std):
                found.setdefault(name, f'{path} {number(value)}, {far} {number(middle)}')
    return found


def _other_poles(bags: Mapping[str, Numbers]) -> dict[str, str]:
    typical = _typical(list(bags.values()))
    partners = {name: paired(typical, numbers.poles) for name, numbers in bags.items()}
    found: dict[str, str] = {}
    for k, near in enumerate(typical):
        own = {name: numbers.poles[partners[name][k]] for name, numbers in bags.items()
               if k in partners[name]}
        values = np.array(list(own.values()))
        middle = complex(np.median(values.real), np.median(values.imag))
        spread = float(np.median(np.abs(values - middle))) * (_PAIR if middle.imag else _REAL)
        for name, numbers in bags.items():
            # Over its size a pole near 0 is far from any other, however little it is known.
            at = partners[name].get(k, int(np.argmin(np.abs(numbers.poles - middle))))
            if far := _far(abs(numbers.poles[at] - middle), spread, numbers.std[at]):
                found.setdefault(name, f'no pole near {pole_text(near)} rad/s' if name not in own
                                 else f'pole {pole_text(own[name])} rad/s, {far} '
                                 f'{pole_text(middle)}')
    return found


def _far(away: float, spread: float, std: float) -> str:
    """Return how far away a number is in words, '' if it may be that of the others."""
    both = max(float(np.hypot(spread, np.nan_to_num(std))), 1e-300)
    return f'{number(away / both, 2)} standard deviations from the median' \
        if away > FAR * both else ''


def _typical(bags: Sequence[Numbers]) -> ComplexArray:
    """Return the poles of a bag that is neither fast nor slow."""
    speeds = [float(np.mean(np.log(np.maximum(np.abs(own.poles), 1e-300)))) for own in bags]
    return bags[int(np.argsort(speeds)[len(bags) // 2])].poles
