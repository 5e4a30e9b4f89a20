# SPDX-License-Identifier: Apache-2.0
"""
Choice of the regression's parameters, of the order and of the noise model.

A subspace estimate costs a fraction of a millisecond, so a grid of (beta, p) is tried and the
most likely model kept. Three questions have to be answered together:

- Unstable? Seen through a window, a pole in the right half plane always explains a little more.
  It is believed only if simulations are much better with it than with the best stable model.
- Process noise? The innovation form is believed if it is more likely by more than simulations
  lose with its poles, and these lose no more than gusts can cost; else its K has taken up plant
  dynamics.
- Which order? The poles of the best candidate of each order are taken to the maximum of the
  output-error likelihood first (else a badly placed mode looks like two), then Schwarz's
  criterion decides (`selection.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.base import Projection
from ctsid_core.pbsid import (
    Levels,
    Matrices,
    Subspace,
    Tuning,
    realise,
    regress,
    stack_levels,
)
from ctsid_core.pole_fit import OutputError, OutputErrorFit
from ctsid_core.prediction_errors import innovation_cost, line_fit, output_error_cost
from ctsid_core.process_noise import with_process_noise
from ctsid_core.refine import affordable, best_simulation, distinct, realise_poles
from ctsid_core.settings import Settings
from ctsid_core.window_ends import ends_cost_of_simulation

_PASTS = (2, 3, 4, 6, 8, 12)
_LENGTHS = 4                  # values of p tried: the shortest that can hold the order
_SHIFTS = 5                   # values of beta tried
_GAMMA = 4.0                  # gamma over beta: the region reaches well beyond the shift
_PATIENCE = 2                 # orders beyond the best one that are tried before giving up
_EXPLAINED = 1e-6             # residual power below this fraction needs no further state
_COLOURED = 64.0              # per state: how much less likely gusts make the true simulation
_SAME = 0.2                   # relative distance of poles that one climb ends at
_STEPS = 12                   # Gauss-Newton steps of the poles
_GLANCE = 4                   # of them, after which a second start must be better
_UNSTABLE = 1.75              # how much better simulations must be to believe an unstable pole


class Candidate:
    """
    A subspace model, and what the data say of it: computed when asked for.

    Parameters
    ----------
    search : Search
        Where it was found.
    subspace : Subspace
    n : int
        Order.
    """

    def __init__(self, search: Search, subspace: Subspace, n: int) -> None:
        self.search = search
        self.subspace = subspace
        self.matrices: Matrices = realise(subspace, n)

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """Poles, shape (n,) [rad/s]."""
        return np.linalg.eigvals(self.matrices.A).astype(complex)

    @cached_property
    def simulated(self) -> OutputErrorFit:
        """Fit of a simulation with these poles (noise of measurement only)."""
        return self.search.output_error.fit(self.poles)

    @cached_property
    def innovation(self) -> float:
        """-2 log likelihood with its own K."""
        return innovation_cost(self.search.projection, self.matrices)

    def refined(self, limit: float, steps: int = _STEPS) -> OutputErrorFit:
        """Return the output-error maximum reached from these poles, within a limit [rad/s]."""
        return self.search.output_error.fit(self.poles, steps, limit)

    @cached_property
    def realised(self) -> float:
        """-2 log likelihood of its own simulation, up to a constant."""
        return output_error_cost(self.search.projection, self.matrices)

    @property
    def growth(self) -> float:
        """Largest real part of the poles [rad/s]."""
        return float(np.max(self.poles.real))


@dataclass(frozen=True)
class Pair:
    """
    The candidate that simulates best and the one of the most likely innovation form.

    Parameters
    ----------
    simulating, predicting : Candidate
    limit : float
        Largest real part that a pole may have: infinite if the plant is unstable [rad/s].
    process_noise : bool
        Whether the second is to be believed.
    """

    simulating: Candidate
    predicting: Candidate
    limit: float
    process_noise: bool

    @property
    def best(self) -> Candidate:
        """The one to be believed."""
        return self.predicting if self.process_noise else self.simulating

    def believes(self, poles: NDArray[np.complex128], gain: float, simulated: float) -> bool:
        """
        Return whether process noise is to be believed.

        Parameters
        ----------
        poles : ndarray, shape (n,)
            That go with it [rad/s].
        gain : float
            By which the data are likelier with it.
        simulated : float
            Cost of the best simulation.

        Notes
        -----
        What K has taken up of the plant is missing in simulations. With gusts they lose a
        little, too, for the best simulation has its poles where these explain some of the gusts:
        in proportion to the number of poles and to the power of the residuals where it is
        largest over its mean, but, unlike what a wrong model loses, however long the record is.
        Measured: less than 40 per state with gusts, more than 100 with model errors. An unstable
        plant is told by predictions only.
        """
        if gain <= 0.0 or self.limit == np.inf:
            return gain > 0.0
        search = self.simulating.search
        loss = search.output_error.fit(poles).cost - simulated
        return loss < min(gain, _COLOURED * len(poles))

    def refined(self) -> OutputErrorFit:
        """Return the best output-error maximum reached from the poles of either."""
        found = self.simulating.refined(self.limit)
        away = np.abs(self.predicting.poles[:, np.newaxis] - found.poles).min(axis=1)
        if np.all(away < _SAME * np.abs(self.predicting.poles)):
            return found
        other = self.predicting.refined(self.limit, _GLANCE)
        if other.cost >= found.cost:
            return found
        return self.predicting.refined(self.limit)


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
    """

    order: int
    pair: Pair
    refined: OutputErrorFit
    start: Matrices | None
    simulation: float
    innovation: float
    residual: float


class Search:
    """
    All subspace models of one projection, computed when asked for.

    Parameters
    ----------
    projection : Projection
    settings : Settings
        Values other than 0 of order, beta, gamma, past and future are kept as they are.
    """

    def __init__(self, projection: Projection, settings: Settings) -> None:
        self.projection = projection
        self.settings = settings
        self._subspace = lru_cache(maxsize=None)(self._regress)
        self._levels = lru_cache(maxsize=None)(self._stack)

    @cached_property
    def output_error(self) -> OutputError:
        """Likelihood of simulations of this projection, as a function of the poles."""
        return OutputError(self.projection, self.settings.feedthrough)

    @property
    def _length(self) -> float:
        """Length of the record, or of one of its parts [s]."""
        p = self.projection
        return (p.end - p.start) / max(len(p.tail), 1)

    @property
    def resolution(self) -> float:
        """Growth that the window cannot tell from none [rad/s]."""
        return 1.0 / self._length

    def tunings(self, n: int) -> list[Tuning]:
        """Return the tunings that the data are long enough for and that can hold order n."""
        top, settings = float(np.abs(self.projection.s[-1])), self.settings
        slow = 10.0 / self._length
        shifts = [settings.beta] if settings.beta else \
            list(np.geomspace(slow, max(0.7 * top, 2.0 * slow), _SHIFTS))
        pasts = [settings.past] if settings.past else \
            [p for p in self._pasts(n) if self._holds(p, n)][:_LENGTHS]
        return [Tuning(b, settings.gamma or _GAMMA * b, p, settings.future or p)
                for b in shifts for p in pasts]

    def some_tunings(self, n: int) -> list[Tuning]:
        """Return a part of the grid: two values of p."""
        tunings = self.tunings(n)
        pasts = sorted({t.past for t in tunings})
        kept = {pasts[0], pasts[len(pasts) // 2]} if pasts else set()
        return [t for t in tunings if t.past in kept]

    def _pasts(self, n: int) -> tuple[int, ...]:
        needed = n // len(self.projection.y) + 2
        return _PASTS if needed <= _PASTS[-1] else (needed, needed + 4)

    def _holds(self, p: int, n: int) -> bool:
        ny = len(self.projection.y)
        rows = (p + 1) * (ny + len(self.projection.u) + len(self.projection.tail) + 1)
        return p * ny > n and 2 * len(self.projection.s) >= 2 * rows

    def _regress(self, tuning: Tuning) -> Subspace:
        # One factorisation serves the past windows up to 6, which most searches stay within.
        top = max(tuning.past, 0 if self.settings.past else 6) + 1
        return regress(self._levels(tuning.beta, tuning.gamma, top), tuning,
                       feedthrough=self.settings.feedthrough,
                       rank_tolerance=self.settings.rank_tolerance)

    def _stack(self, beta: float, gamma: float, top: int) -> Levels:
        return stack_levels(self.projection, beta, gamma, top)

    def candidates(self, n: int, tunings: list[Tuning]) -> Iterator[Candidate]:
        """Yield the models of order n of the given tunings; those not finite are left out."""
        for tuning in tunings:
            subspace = self._subspace(tuning)
            if n > len(subspace.singular_values):
                continue
            candidate = Candidate(self, subspace, n)
            if np.isfinite(candidate.matrices.A).all():
                yield candidate

    def pair(self, n: int, *, thorough: bool = True) -> Pair | None:
        """
        Return the best models of order n, or None if the data are too short for any.

        Parameters
        ----------
        n : int
        thorough : bool
            Try the whole grid, not a part of it.
        """
        tunings = self.tunings(n) if thorough else self.some_tunings(n)
        found = list(self.candidates(n, tunings))
        if not found:
            return None
        limit = self.resolution
        if len(found) == 1:
            limit = limit if found[0].growth <= limit else np.inf
            return Pair(found[0], found[0], limit, process_noise=True)
        stable = [c for c in found if c.growth <= limit]
        first = min(found, key=self._simulation)
        if stable and first.growth > limit:
            calm = min(stable, key=self._simulation)
            if calm.simulated.cost - first.simulated.cost < self.worth(_UNSTABLE):
                first = calm
        if first.growth > limit:
            limit, group = np.inf, [c for c in found if c.growth > limit]
        else:
            group = stable
        second = min(group, key=lambda c: c.innovation)
        cost = first.simulated.cost
        both = Pair(first, second, limit, process_noise=False)
        return replace(both, process_noise=both.believes(
            second.poles, cost - second.innovation, cost))

    def _simulation(self, candidate: Candidate) -> float:
        """
        Return what simulations with a candidate cost.

        Its poles tell that alone where residues have rank one anyhow. With several inputs and
        outputs one pole could do the work of several equal ones (roll and pitch of a symmetric
        vehicle), which no model of that order can.
        """
        return candidate.realised if self._several else candidate.simulated.cost

    @property
    def _several(self) -> bool:
        return min(len(self.projection.y), len(self.projection.u)) > 1

    def worth(self, ratio: float) -> float:
        """Return the cost of residuals larger by a ratio in all outputs."""
        return float(2 * len(self.projection.s) * len(self.projection.y) * 2.0 * np.log(ratio))

    def price(self, n: int) -> float:
        """Return what Schwarz's criterion charges for an innovation form of order n."""
        p = self.projection
        ny, inputs = len(p.y), len(p.u) + len(p.tail)
        direct = ny * (len(p.u) * self.settings.feedthrough + len(p.ones))
        return float((n * (inputs + 2 * ny) + direct) * self.charge)

    @property
    def charge(self) -> float:
        """What Schwarz's criterion charges for one parameter."""
        return float(np.log(len(self.projection.y) * 2.0 * len(self.projection.s)))

    def trial(self, n: int) -> OrderTrial | None:
        """Return the best of order n, its poles at the output-error maximum."""
        pair = self.pair(n, thorough=False)
        if pair is None:
            return None
        refined = pair.refined()
        simulation = refined.cost + refined.parameters * self.charge
        residual, model = refined.residual, pair.simulating.matrices
        p, feed = self.projection, self.settings.feedthrough
        if self._several:
            ny, direct = len(p.y), len(p.ones) + len(p.u) * feed
            count = n * (len(p.u) + len(p.tail) + ny) + ny * direct
            model, cost = best_simulation(p, model, refined.poles, feed, pair.limit)
            simulation = cost + count * self.charge
            residual = float(np.max((1.0 - 0.01 * line_fit(p, model)) ** 2))
        elif distinct(refined.poles):
            model = realise_poles(p, refined.poles, feed)
        simulation += ends_cost_of_simulation(p, refined.poles)
        start, cost = self._innovation_start(pair, model)
        return OrderTrial(n, pair, refined, start, simulation, cost + self.price(n), residual)

    def _innovation_start(self, pair: Pair, simulating: Matrices) -> tuple[Matrices | None, float]:
        found = pair.predicting.matrices, pair.predicting.innovation
        if not (self.settings.refine and affordable(self.projection, len(simulating.A))):
            return found
        other = with_process_noise(self.projection, simulating, self.settings.feedthrough)
        if other is None:
            return None, found[1]
        return min(found, (other, innovation_cost(self.projection, other)), key=lambda x: x[1])

    def orders(self) -> list[OrderTrial]:
        """
        Try the orders from 1 upwards until the smaller criterion does not fall any more.

        Orders at which only unstable models were found are left out unless these simulate much
        better than the stable ones of lower order.
        """
        trials: list[OrderTrial] = []
        for n in range(1, self.settings.max_order + 1):
            trial = self.trial(n)
            if trial is None:
                break
            calm = [t.refined.cost for t in trials if t.pair.limit < np.inf]
            if not (trial.pair.limit == np.inf and calm
                    and min(calm) - trial.refined.cost < self.worth(_UNSTABLE)):
                trials.append(trial)
            last = min(trials, key=by_either).order
            if trial.residual <= _EXPLAINED or n - last >= _PATIENCE:
                break
        return trials


def by_simulation(trial: OrderTrial) -> float:
    """Return the criterion of a trial without process noise."""
    return trial.simulation


def by_innovation(trial: OrderTrial) -> float:
    """Return the criterion of a trial with process noise."""
    return trial.innovation


def by_either(trial: OrderTrial) -> float:
    """Return the smaller criterion of a trial."""
    return min(trial.simulation, trial.innovation)
