# SPDX-License-Identifier: Apache-2.0
"""
Subspace models of one order as starts of the search for the most likely one.

Two questions are answered here:

- Unstable? Seen through a window, a pole in the right half plane always explains a little more.
  It is accepted only if simulations are much better with it than with the best stable model.
- Process noise? The innovation form is believed if it is more likely by more than simulations
  lose with its poles, and these lose no more than gusts can cost; else its K has taken up plant
  dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection
from ctsid_core.likelihood.many_models import innovation_costs, output_error_costs
from ctsid_core.likelihood.prediction_errors import noise_power
from ctsid_core.likelihood.refine import best_simulation
from ctsid_core.likelihood.simulation_of_poles import OutputError, OutputErrorFit
from ctsid_core.linear.matrices import Matrices
from ctsid_core.subspace.pbsid_equations import Subspace, realise

_COLOURED = 64.0              # per state: how much less likely gusts make the true simulation
_PAID = 0.5                   # of the gain: the most that simulations lose by strong gusts
_CHANCE = 3.0                 # deviations of chi-squared that are no surprise
_SAME = 0.2                   # relative distance of poles that one climb ends at
_STEPS = 12                   # Gauss-Newton steps of the poles
_GLANCE = 4                   # of them, after which a second start must be better
UNSTABLE = 1.75              # how much better simulations must be to believe an unstable pole


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    A subspace model, and its likelihood.

    Parameters
    ----------
    output_error : OutputError
        Likelihood of simulations of the data, as a function of the poles.
    subspace : Subspace
        Where it was realised from.
    matrices : Matrices
    poles : ndarray, shape (n,)
        [rad/s].
    simulation : float
        What simulations with it cost: -2 log likelihood. Its poles tell that alone where residues
        have rank one anyhow. With several inputs and outputs one pole could do the work of
        several equal ones (roll and pitch of a symmetric vehicle), which no model of that order
        can: it is the cost of its own simulation then.
    innovation : float
        -2 log likelihood with its own K.
    """

    output_error: OutputError
    subspace: Subspace
    matrices: Matrices
    poles: NDArray[np.complex128]
    simulation: float
    innovation: float

    @cached_property
    def simulated(self) -> OutputErrorFit:
        """Fit of a simulation with these poles (noise of measurement only)."""
        return self.output_error.fit(self.poles)

    def refined(self, limit: float, steps: int = _STEPS) -> OutputErrorFit:
        """Return the output-error maximum reached from these poles, within a limit [rad/s]."""
        return self.output_error.fit(self.poles, steps, limit)

    @property
    def growth(self) -> float:
        """Largest real part of the poles [rad/s]."""
        return float(np.max(self.poles.real))


def realised(output_error: OutputError, subspaces: Sequence[Subspace],
             n: int) -> list[Candidate]:
    """
    Return the models of order n of many subspaces; those that are not finite are left out.

    Parameters
    ----------
    output_error : OutputError
    subspaces : sequence of Subspace
        Those with fewer than n singular values are left out.
    n : int
    """
    made = [(subspace, realise(subspace, n)) for subspace in subspaces
            if n <= len(subspace.singular_values)]
    made = [(subspace, m) for subspace, m in made if np.isfinite(m.A).all()]
    if not made:
        return []
    projection, models = output_error.projection, [m for _, m in made]
    poles = list(np.linalg.eigvals(np.stack([m.A for m in models])).astype(complex))
    simulation = output_error_costs(projection, models) if several(projection) else \
        output_error.costs(poles)
    innovation = innovation_costs(projection, models)
    return [Candidate(output_error, *rest) for rest in (
        (subspace, m, p, float(cost), float(other)) for (subspace, m), p, cost, other in
        zip(made, poles, simulation, innovation, strict=True))]


def several(projection: Projection) -> bool:
    """Return whether there are several inputs and several outputs."""
    return min(len(projection.y), len(projection.u)) > 1


def worth(projection: Projection, ratio: float) -> float:
    """Return the cost of residuals larger by a ratio in all outputs."""
    return float(2 * len(projection.s) * len(projection.y) * 2.0 * np.log(ratio))


@dataclass(frozen=True, eq=False)
class Pair:
    """
    The candidate that simulates best and the one of the most likely innovation form.

    Parameters
    ----------
    simulating, predicting : Candidate
    limit : float
        Largest real part that a pole may have: infinite if the plant is unstable [rad/s].
    process_noise : bool
        Whether the second is accepted.
    tried : int
        How many candidates there were.
    lenient : bool
        Whether process noise is accepted even where simulations lose much by it.
    """

    simulating: Candidate
    predicting: Candidate
    limit: float
    process_noise: bool
    tried: int
    lenient: bool = True

    @property
    def best(self) -> Candidate:
        """The accepted one."""
        return self.predicting if self.process_noise else self.simulating

    def accepts_process_noise(self, m: Matrices, gain: float, simulated: OutputErrorFit) -> bool:
        """
        Return whether process noise is accepted.

        Parameters
        ----------
        m : Matrices
            The model with process noise.
        gain : float
            By which the data are more likely with it.
        simulated : OutputErrorFit
            The best simulation.

        Notes
        -----
        What K has taken up of the plant is missing in simulations. With gusts they lose a
        little, too, for the best simulation has its poles where these explain some of the gusts:
        in proportion to the number of poles and to the power of the residuals where it is
        largest over its mean, but, unlike what a wrong model loses, however long the record is.
        Measured: less than 40 per state with gusts, more than 100 with model errors. Strong gusts
        cost more, unless lines count by the noise in them that K stands for; but they gain more
        than twice what they cost (measured: at most 0.45 of the gain at the right order, model
        errors 0.56 and more). An unstable plant is judged by predictions only.
        """
        if gain <= 0.0 or self.limit == np.inf:
            return gain > 0.0
        plain = self.simulating.output_error
        poles = np.linalg.eigvals(m.A).astype(complex)
        allowed = _COLOURED * len(poles)
        loss = plain.fit(poles).cost - simulated.cost
        if not self.lenient or loss < allowed or loss > _PAID * gain:
            return loss < min(gain, allowed)
        p = plain.projection
        size = 1.0 / np.sqrt(np.mean(noise_power(p, m), axis=0))
        weighted = OutputError(replace(p, u=p.u * size, y=p.y * size, tail=p.tail * size,
                                       ones=p.ones * size), plain.feedthrough)
        best = min(weighted.fit(start, _STEPS, self.limit).cost
                   for start in (poles, simulated.poles))
        return weighted.fit(poles).cost - best < allowed

    def noise_model_uncertain(self, m: Matrices) -> bool:
        """Return whether process noise is accepted for lack of a better explanation only."""
        return not replace(self, lenient=False).accepts_process_noise(m, np.inf, self.refined)

    @cached_property
    def refined(self) -> OutputErrorFit:
        """The best output-error maximum reached from the poles of either."""
        found = self.simulating.refined(self.limit)
        away = np.abs(self.predicting.poles[:, np.newaxis] - found.poles).min(axis=1)
        if np.all(away < _SAME * np.abs(self.predicting.poles)):
            return found
        other = self.predicting.refined(self.limit, _GLANCE)
        if other.cost >= found.cost:
            return found
        return self.predicting.output_error.fit(other.poles, _STEPS, self.limit)

    @cached_property
    def simulation(self) -> tuple[Matrices, float]:
        """The model at the maximum of the output-error likelihood, and what it costs."""
        first, free = self.simulating, self.refined
        projection = first.output_error.projection
        driven = len(projection.u) + len(projection.tail)
        # Residues of rank one cost what so many parameters may cost by chance.
        fewer = len(free.poles) * (len(projection.y) - 1) * (driven - 1)
        return best_simulation(projection, first.matrices, free.poles,
                               first.output_error.feedthrough, self.limit,
                               good=free.cost + fewer + _CHANCE * np.sqrt(2.0 * fewer))


def best_pair(found: Sequence[Candidate], limit: float, *, lenient: bool = True) -> Pair:
    """
    Return the best of the candidates of one order.

    Parameters
    ----------
    found : sequence of Candidate
        Not empty.
    limit : float
        Largest real part of a pole that counts as stable [rad/s].
    lenient : bool
        See `Pair`.
    """
    if len(found) == 1:
        limit = limit if found[0].growth <= limit else np.inf
        return Pair(found[0], found[0], limit, process_noise=True, tried=1, lenient=lenient)
    stable = [c for c in found if c.growth <= limit]
    first = min(found, key=_by_simulation)
    if stable and first.growth > limit:
        calm = min(stable, key=_by_simulation)
        if calm.simulated.cost - first.simulated.cost < worth(
                first.output_error.projection, UNSTABLE):
            first = calm
    if first.growth > limit:
        limit, group = np.inf, [c for c in found if c.growth > limit]
    else:
        group = stable
    second = min(group, key=_by_innovation)
    both = Pair(first, second, limit, process_noise=False, tried=len(found), lenient=lenient)
    return replace(both, process_noise=both.accepts_process_noise(
        second.matrices, first.simulated.cost - second.innovation, first.simulated))


def _by_simulation(candidate: Candidate) -> float:
    return candidate.simulation


def _by_innovation(candidate: Candidate) -> float:
    return candidate.innovation
