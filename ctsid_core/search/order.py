# SPDX-License-Identifier: Apache-2.0
"""
Choice of the order.

A subspace estimate costs a fraction of a millisecond, so a grid of (beta, p) is tried
(`subspace/hd_pbsid.py`) and the most likely model kept (`starts.py`). The poles of the best
candidate of each order are taken to the maximum of the output-error likelihood before orders are
compared (else a badly placed mode looks like two), then Schwarz's criterion decides
(`selection.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ctsid_core.bases.projection import Projection
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    line_fit,
    prediction_errors,
    simulate_lines,
)
from ctsid_core.likelihood.process_noise import with_process_noise
from ctsid_core.likelihood.refine import affordable, distinct, realise_poles
from ctsid_core.likelihood.simulation_of_poles import OutputError, OutputErrorFit
from ctsid_core.likelihood.spectral_peak import highest_peak
from ctsid_core.likelihood.window_ends import ends_cost_of_simulation
from ctsid_core.linear.matrices import Matrices
from ctsid_core.search.starts import UNSTABLE, Candidate, Pair, best_pair, realised, several, worth
from ctsid_core.settings import Settings
from ctsid_core.subspace.hd_pbsid import Subspaces
from ctsid_core.subspace.pbsid_equations import Tuning

FIRST = 2                    # order that the search begins with
_PATIENCE = 2                 # orders beyond the best one that are tried before giving up
_WHITE = 1e-2                 # chance above which errors count as white
_COLOURED, _LOUD = 1e-12, 3.0  # chance and ratio of a peak beyond which a mode is missing
_MARGIN = 10.0                # by which lower orders must be worse: no maximum is exact
NOTHING_LEFT = 1e-6             # residual power below this fraction needs no further state
_BENT = 1e-12                # the same where interpolation has no part in it


@dataclass(frozen=True)
class OrderTrial:
    """
    The best that was found at one order.

    Parameters
    ----------
    order : int
    pair : Pair
    refined : OutputErrorFit
        The simulating candidate's poles at the output-error maximum.
    start : Matrices or None
        The likelier of two innovation forms: the subspace model, and the simulation with the
        process noise that its residuals show. None if they show none.
    simulation, innovation : float
        Schwarz's criterion of the two noise models; the smallest wins. The second is that of
        `start`, or else of the subspace model, not of a maximum.
    residual : float
        Largest part of an output's power, its level apart, that the best simulation leaves.
    white : bool
        Whether the simulation's errors are white.
    lacking : bool
        Whether they, and those of `start` too, show that something big is missing.
    """

    order: int
    pair: Pair
    refined: OutputErrorFit
    start: Matrices | None
    simulation: float
    innovation: float
    residual: float
    white: bool
    lacking: bool

    @property
    def criterion(self) -> float:
        """The smaller of the two criteria."""
        return min(self.simulation, self.innovation)


class Search:
    """
    All subspace models of one projection, computed when asked for.

    Parameters
    ----------
    projection : Projection
    settings : Settings
        Values other than 0 of order, beta, gamma, past and future are kept as they are.
    lenient : bool
        See `Pair`.
    """

    def __init__(self, projection: Projection, settings: Settings, *,
                 lenient: bool = True) -> None:
        self.projection = projection
        self.settings = settings
        self.lenient = lenient
        self.subspaces = Subspaces(projection, settings)
        self.trial = lru_cache(maxsize=None)(self._trial)

    @cached_property
    def output_error(self) -> OutputError:
        """Likelihood of simulations of this projection, as a function of the poles."""
        return OutputError(self.projection, self.settings.feedthrough)

    @property
    def resolution(self) -> float:
        """Growth that the window cannot tell from none [rad/s]."""
        return 1.0 / self.projection.length

    def candidates(self, n: int, tunings: list[Tuning]) -> list[Candidate]:
        """Return the models of order n of the given tunings; those not finite are left out."""
        return realised(self.output_error, [self.subspaces.of(t) for t in tunings], n)

    def pair(self, n: int, *, thorough: bool = True) -> Pair | None:
        """
        Return the best models of order n, or None if the data are too short for any.

        Parameters
        ----------
        n : int
        thorough : bool
            Try the whole grid, not a part of it.
        """
        found = self.candidates(n, self.subspaces.tunings(n) if thorough else
                                self.subspaces.some_tunings(n))
        return best_pair(found, self.resolution, lenient=self.lenient) if found else None

    def price(self, n: int) -> float:
        """Return what Schwarz's criterion charges for an innovation form of order n."""
        p = self.projection
        ny, inputs = len(p.y), len(p.u) + len(p.tail)
        direct = ny * (len(p.u) * self.settings.feedthrough + len(p.ones))
        return float((n * (inputs + 2 * ny) + direct) * self.charge) - self._discount(n)

    @property
    def explained(self) -> float:
        """Residual power, over that of an output, below which no further state is needed."""
        return _BENT if self.projection.bent else NOTHING_LEFT

    @property
    def charge(self) -> float:
        """What Schwarz's criterion charges for one parameter."""
        return float(np.log(len(self.projection.y) * 2.0 * len(self.projection.s)))

    def _discount(self, n: int) -> float:
        """Return by how much states and trim of records, each told by one alone, cost less."""
        ny = len(self.projection.y)
        return sum((n * len(p.tail) + ny * len(p.ones))
                   * (self.charge - float(np.log(ny * 2.0 * len(p.s))))
                   for p in self.projection.records)

    def _trial(self, n: int) -> OrderTrial | None:
        """Return the best of order n, its poles at the output-error maximum."""
        pair = self.pair(n, thorough=False)
        if pair is None:
            return None
        refined, ny = pair.refined, len(self.projection.y)
        simulation = refined.cost + refined.parameters * self.charge - self._discount(n * ny)
        residual, model = refined.residual, pair.simulating.matrices
        p, feed = self.projection, self.settings.feedthrough
        if several(self.projection):
            direct = len(p.ones) + len(p.u) * feed
            count = n * (len(p.u) + len(p.tail) + ny) + ny * direct
            model, cost = pair.simulation
            simulation = cost + count * self.charge - self._discount(n)
            residual = float(np.max((1.0 - 0.01 * line_fit(p, model)) ** 2))
        elif distinct(refined.poles):
            model = realise_poles(p, refined.poles, feed)
        simulation += ends_cost_of_simulation(p, refined.poles)
        start, cost = self._innovation_start(pair, model)
        peaks = [highest_peak(p.y - simulate_lines(p, model))]
        if start is not None:
            peaks.append(highest_peak(prediction_errors(p, start)))
        return OrderTrial(
            n, pair, refined, start, simulation, cost + self.price(n), residual,
            white=peaks[0].p_value > _WHITE,
            lacking=all(peak.p_value < _COLOURED and peak.ratio > _LOUD for peak in peaks))

    def _innovation_start(self, pair: Pair, simulating: Matrices) -> tuple[Matrices | None, float]:
        found = pair.predicting.matrices, pair.predicting.innovation
        if not (self.settings.refine and affordable(self.projection, len(simulating.A))):
            return found
        other = with_process_noise(self.projection, simulating, self.settings.feedthrough)
        if other is None:
            return None, found[1]
        return min(found, (other, innovation_cost(self.projection, other)), key=lambda x: x[1])

    def orders(self, first: int = FIRST) -> list[OrderTrial]:
        """
        Try orders upwards from the first one, then downwards, as long as they may be better.

        Parameters
        ----------
        first : int
            Where to begin. It changes how long the search takes, and hardly ever what it finds.

        Returns
        -------
        list of OrderTrial
            By order; empty if the data are too short for any. Orders at which only unstable
            models were found are left out unless these simulate much better than the stable
            ones of lower order.
        """
        tried: dict[int, OrderTrial] = {}
        for n in range(min(first, self.settings.max_order), self.settings.max_order + 1):
            trial = self.trial(n)
            if trial is None:
                break
            tried[n] = trial
            if trial.residual <= self.explained or self._far_beyond(tried, n):
                break
        for n in range(min(tried, default=2) - 1, 0, -1):
            if tried and self._far_below(tried, n):
                break
            trial = self.trial(n)
            if trial is None:
                break
            tried[n] = trial
        return self._believed([tried[n] for n in sorted(tried)])

    def _far_beyond(self, tried: dict[int, OrderTrial], n: int) -> bool:
        """
        Return whether orders above n need not be tried.

        Where the simulation of the best order leaves white errors, the next one tells: half the
        price of a state has to come in at least. White errors of a predictor tell nothing, for
        its K can take up what is missing.
        """
        best = min(self._believed(list(tried.values())), key=by_either)
        ahead = n - best.order
        short = tried[n].criterion - best.criterion > 0.5 * self._price_of_state
        if best.white and short and ahead >= 1:
            return True
        return ahead >= (2 * _PATIENCE if best.lacking else _PATIENCE)

    def _far_below(self, tried: dict[int, OrderTrial], n: int) -> bool:
        """
        Return whether order n and lower ones cannot be better than what was found.

        A model with fewer states does not explain more: at best it is as likely as the one above
        it, and cheaper.
        """
        best, above = min(t.criterion for t in tried.values()), tried[n + 1]
        return above.residual > self.explained and \
            above.criterion - n * self._price_of_state - _MARGIN > best

    def _believed(self, trials: list[OrderTrial]) -> list[OrderTrial]:
        """Return the trials but those unstable, or of more states, for little."""
        explained = [t.order for t in trials if t.residual <= self.explained]
        trials = [t for t in trials if t.order <= min(explained, default=t.order)]
        return [t for t in trials if not (
            t.pair.limit == np.inf and any(
                c.refined.cost - t.refined.cost < worth(self.projection, UNSTABLE)
                for c in trials if c.order < t.order and c.pair.limit < np.inf))]

    @property
    def _price_of_state(self) -> float:
        return self.price(2) - self.price(1)


def by_simulation(trial: OrderTrial) -> float:
    """Return the criterion of a trial without process noise."""
    return trial.simulation


def by_innovation(trial: OrderTrial) -> float:
    """Return the criterion of a trial with process noise."""
    return trial.innovation


def by_either(trial: OrderTrial) -> float:
    """Return the smaller criterion of a trial."""
    return trial.criterion
