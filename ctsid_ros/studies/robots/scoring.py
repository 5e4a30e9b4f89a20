# SPDX-License-Identifier: Apache-2.0
"""One identification of one experiment: what it gave, and whether that is right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.studies.robots.experiment import Experiment
from ctsid_ros.studies.robots.regression import prediction_errors
from ctsid_ros.studies.robots.trials import response_off, simulated

USABLE = 85.0           # reachable fit [%] above which a model is worth having
NEAR = 2.0              # points of fit below what is reachable that do not matter
FAR = 5.0               # that do
AS_GOOD = 1.02          # error over the regression's that is as good
DIVERGED = -100.0       # fit [%]
NONE = (float('nan'),) * 3


@dataclass(frozen=True)
class Row:
    """
    What came of one experiment.

    Parameters
    ----------
    family, kind : str
    seed, number : int
    judge : str
        See `Experiment`.
    grade, reason, status : str
        Of the estimate; the grade is LATE if it was given up.
    order : int
        0 if there is no model.
    delay : float
        Largest dead time of the model [s].
    seconds : float
        Of the processor.
    own_fit : float
        What the estimate says of the worst output [%].
    test_fit : float
        Of the model on the test, mean of the outputs [%]; of predictions: of the worst horizon.
    reachable : float
        The same of brute-force output error; of the regression at that horizon.
    ratios : tuple of 3 floats
        Errors over the regression's, by horizon.
    response_off : float
        Largest error of the frequency response in the excited band [%].
    usable, near, wrong, false_no, divergent : bool
        Reachable above 85 %; model within 2 points of reachable, whatever its grade (of
        predictions: as good as the regression at each horizon); GOOD but wrong; WEAK or REJECT
        although near; test fit below -100 %.
    """

    family: str
    kind: str
    seed: int
    number: int
    judge: str
    grade: str
    reason: str
    status: str
    order: int = 0
    delay: float = 0.0
    seconds: float = 0.0
    own_fit: float = float('nan')
    test_fit: float = float('nan')
    reachable: float = float('nan')
    ratios: tuple[float, ...] = NONE
    response_off: float = float('nan')
    usable: bool = False
    near: bool = False
    wrong: bool = False
    false_no: bool = False
    divergent: bool = False

    @property
    def good(self) -> bool:
        """Whether the grade is GOOD."""
        return self.grade == 'GOOD'


def score(experiment: Experiment, estimate: Estimate | None, reachable: tuple[float, ...],
          seconds: float) -> Row:
    """
    Judge an estimate.

    Parameters
    ----------
    experiment : Experiment
    estimate : Estimate or None
        None if it was given up.
    reachable : tuple of float
        The reachable fit [%]; of predictions the regression's error at each horizon, then those
        of the filter that knows the robot: the larger one is the measure, for the regression
        has the advantage that future inputs tell it what the controller has seen by then.
    seconds : float
        That it took.
    """
    if estimate is None:
        return _row(experiment, 'LATE', 'given up', 'LATE', seconds=seconds,
                    reachable=_of_reach(experiment, reachable),
                    usable=_usable(experiment, reachable))
    model, grade = estimate.model or estimate.rejected_model, estimate.verdict.grade.name
    plain: dict[str, Any] = {
        'grade': grade, 'reason': estimate.verdict.reason, 'status': estimate.status.name,
        'seconds': seconds, 'usable': _usable(experiment, reachable),
        'own_fit': float(np.min(estimate.fit)) if len(estimate.fit) else float('nan'),
        'reachable': _of_reach(experiment, reachable)}
    if model is None:
        return _row(experiment, **plain)
    plain |= {'order': model.n, 'delay': max(model.delay, default=0.0)}
    if experiment.judge == 'none':
        return _row(experiment, **plain, wrong=grade == 'GOOD')
    found = _predicted(experiment, model, reachable) if experiment.judge == 'prediction' \
        else _simulated(experiment, model, estimate, reachable[0])
    wrong = found.pop('wrong') and grade == 'GOOD'
    false_no = bool(found['near'] and plain['usable'] and grade != 'GOOD')
    return _row(experiment, **plain | found, wrong=wrong, false_no=false_no)


def _row(experiment: Experiment, grade: str = '', reason: str = '', status: str = '',
         **more: Any) -> Row:
    return Row(experiment.family, experiment.kind, experiment.seed, experiment.number,
               experiment.judge, grade, reason, status, **more)


def _usable(experiment: Experiment, reachable: tuple[float, ...]) -> bool:
    return experiment.judge == 'prediction' or (
        experiment.judge == 'simulation' and reachable[0] > USABLE)


def _of_reach(experiment: Experiment, reachable: tuple[float, ...]) -> float:
    if experiment.judge == 'none':
        return float('nan')
    return reachable[0] if experiment.judge == 'simulation' else \
        100.0 * (1.0 - max(reachable))


def _simulated(experiment: Experiment, model: StateSpace, estimate: Estimate,
               reachable: float) -> dict[str, Any]:
    assert experiment.test is not None
    fit = float(np.mean(simulated(model, experiment.test)))
    off, wrong = response_off(experiment, model, estimate)
    return {'test_fit': fit, 'near': fit > reachable - NEAR, 'divergent': fit < DIVERGED,
            'response_off': off, 'wrong': wrong or fit < reachable - FAR}


def _predicted(experiment: Experiment, model: StateSpace,
               reachable: tuple[float, ...]) -> dict[str, Any]:
    """Judge by predictions; 5 points of fit are 0.05 of the motion, as in simulation."""
    assert experiment.test is not None
    errors = np.array(prediction_errors(model, experiment.test))
    regression = np.array(reachable[:len(errors)])
    measure = np.maximum(regression, reachable[len(errors):])
    worst = int(np.argmax(errors - measure))
    fit = max(100.0 * (1.0 - float(errors[worst])), -1e30)
    return {'test_fit': fit, 'reachable': 100.0 * (1.0 - float(measure[worst])),
            'ratios': tuple((errors / regression).tolist()),
            'near': bool((errors <= AS_GOOD * measure).all()), 'divergent': fit < DIVERGED,
            'wrong': bool(errors[worst] > measure[worst] + 0.01 * FAR)}
