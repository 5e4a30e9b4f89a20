# SPDX-License-Identifier: Apache-2.0
"""
Who runs against whom: this project and other free packages, each in its documented way.

Peers are told the order. Their discrete poles are mapped by log(z) / Ts. The settings marked
with * serve that peer best among some hundred combinations of decimation and horizon, on the
very data of the benchmark: a choice that needs the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from common import POLES, Array
import numpy as np
from numpy.typing import NDArray
from scipy.signal import decimate

from ctsid_core import Record, Settings, identify

Poles = NDArray[np.complex128]
Found = tuple[Poles, int | None]            # poles [rad/s]; the order that was found, if any was
Run = Callable[[Array, Array, Array], Found]

ORDER = len(POLES)


@dataclass(frozen=True)
class Contender:
    """
    One line of the table.

    Parameters
    ----------
    name : str
    run : callable
        From stamps (N,), input (N,) and outputs (N, 2) to what was found.
    module : str
        What has to be installed; '' for this project.
    """

    name: str
    run: Run
    module: str = ''


def ctsid(**given: Any) -> Run:
    """Return a run of this project with some settings; what is not given it finds itself."""
    settings = Settings(**given)

    def run(t: Array, u: Array, y: Array) -> Found:
        estimate = identify(Record.from_arrays(t, u, t, y), settings)
        if estimate.model is None:
            raise ArithmeticError(estimate.status.value)
        return estimate.model.poles, None if settings.order else estimate.model.n

    return run


def slicot(rows: int, every: int = 1, order: int = ORDER) -> Run:
    """Return a run of PO-MOESP: IB01AD with the fast Cholesky algorithm, then IB01BD."""

    def run(t: Array, u: Array, y: Array) -> Found:
        import ctrlsys
        t, u, y = averaged(t, u, y, every)
        inputs, outputs = np.asfortranarray(u[:, np.newaxis]), np.asfortranarray(y)
        found, r, _, _, info = ctrlsys.ib01ad(
            'M', 'C', 'M', 'O', 'N', 'N', rows, 1, 2, inputs, outputs, 0.0, -1.0)
        _succeed('IB01AD', info)
        a, *_, info = ctrlsys.ib01bd('M', 'A', 'N', rows, order, 1, 2, len(t), r, 0.0)
        _succeed('IB01BD', info)
        return continuous(a, t), found

    return run


def _succeed(routine: str, info: int) -> None:
    if info != 0:
        raise ArithmeticError(f'{routine} returned info = {info}')


def nfoursid(rows: int | None = None, every: int = 1) -> Run:
    """Return a run of nfoursid with its default or a given number of block rows."""

    def run(t: Array, u: Array, y: Array) -> Found:
        from nfoursid.nfoursid import NFourSID
        import pandas
        t, u, y = filtered(t, u, y, every)
        frame = pandas.DataFrame({'u': u, 'y1': y[:, 0], 'y2': y[:, 1]})
        more = {} if rows is None else {'num_block_rows': rows}
        method = NFourSID(frame, output_columns=['y1', 'y2'], input_columns=['u'], **more)
        method.subspace_identification()
        model, _ = method.system_identification(rank=ORDER)
        return continuous(model.a, t), None

    return run


def sippy(method: str, horizon: int | None = None, every: int = 1) -> Run:
    """Return a run of SIPPY with its default (20) or a given horizon."""

    def run(t: Array, u: Array, y: Array) -> Found:
        from sippy_unipi import system_identification
        t, u, y = averaged(t, u, y, every)
        more = {} if horizon is None else {'SS_f': horizon, 'SS_p': horizon}
        model = system_identification(y.T, u[np.newaxis], method, tsample=t[1] - t[0],
                                      SS_fixed_order=ORDER, **more)
        return continuous(model.A, t), None

    return run


def jax_sysid(t: Array, u: Array, y: Array) -> Found:
    """Run jax-sysid's continuous-time model from stable poles that were set by hand."""
    import diffrax
    import jax
    from jax_sysid.models import CTModel
    from jax_sysid.utils import standard_scale
    jax.config.update('jax_enable_x64', True)
    scaled_y, scaled_u = standard_scale(y)[0], standard_scale(u[:, np.newaxis])[0]
    model = CTModel(ORDER, 2, 1,
                    state_fcn=jax.jit(lambda x, v, at, p: p[0] @ x + p[1] @ v),
                    output_fcn=jax.jit(lambda x, v, at, p: p[2] @ x + p[3] @ v))
    model.integration_options(interpolation_type='linear', ode_solver=diffrax.Heun(),
                              dt0=t[1] - t[0])
    rng = np.random.default_rng(1)
    model.init(params=[np.diag([-1.0, -5.0]), 0.1 * rng.standard_normal((ORDER, 1)),
                       0.1 * rng.standard_normal((2, ORDER)), np.zeros((2, 1))])
    model.loss(rho_x0=1e-8, rho_th=1e-8, train_x0=True)
    model.optimization(adam_epochs=0, lbfgs_epochs=500, iprint=-1)
    model.fit(scaled_y, scaled_u, t, t)
    return np.linalg.eigvals(np.asarray(model.params[0])).astype(complex), None


def continuous(a: Array, t: Array) -> Poles:
    """Map the poles of a discrete model to rad/s."""
    with np.errstate(divide='ignore'):
        poles: Poles = np.log(np.linalg.eigvals(a).astype(complex)) / (t[1] - t[0])
    return poles


def averaged(t: Array, u: Array, y: Array, every: int) -> tuple[Array, Array, Array]:
    """Replace so many samples in turn by their mean."""
    count = len(t) // every
    means = [x[:count * every].reshape(count, every, *x.shape[1:]).mean(axis=1)
             for x in (t, u, y)]
    return means[0], means[1], means[2]


def filtered(t: Array, u: Array, y: Array, every: int) -> tuple[Array, Array, Array]:
    """Keep one of so many samples behind SciPy's default anti-aliasing filter."""
    if every == 1:
        return t, u, y
    return t[::every], decimate(u, every), decimate(y, every, axis=0)


CONTENDERS = (
    Contender('ctsid, nothing set', ctsid()),
    Contender('ctsid, order given', ctsid(order=ORDER)),
    Contender('ctsid, order given, subspace only', ctsid(order=ORDER, refine=False)),
    Contender('ctsid, all given as in the paper, subspace only', ctsid(
        order=ORDER, nmax=250, beta=3.0, gamma=20.0, past=3, refine=False, held_out=0.0)),
    Contender('SLICOT PO-MOESP, s = 60', slicot(60), 'ctrlsys'),
    Contender('SLICOT PO-MOESP, s = 20', slicot(20), 'ctrlsys'),
    Contender('SLICOT PO-MOESP, means of 8, s = 12 *', slicot(12, 8), 'ctrlsys'),
    Contender('nfoursid, default (2 block rows)', nfoursid(), 'nfoursid'),
    Contender('nfoursid, 10 block rows as in its example', nfoursid(10), 'nfoursid'),
    Contender('nfoursid, decimated by 8, 3 block rows *', nfoursid(3, 8), 'nfoursid'),
    Contender('SIPPY MOESP, default', sippy('MOESP'), 'sippy_unipi'),
    Contender('SIPPY PARSIM-S, default', sippy('PARSIM-S'), 'sippy_unipi'),
    Contender('SIPPY PARSIM-S, means of 8, horizon 12 *', sippy('PARSIM-S', 12, 8),
              'sippy_unipi'),
)
SLOW = Contender('jax-sysid, start given by hand', jax_sysid, 'jax_sysid')
