# SPDX-License-Identifier: Apache-2.0
"""Plants that many tests share, and where the real recordings are."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Plant:
    """dx/dt = A x + B u, y = C x + D u."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    @property
    def poles(self) -> np.ndarray:
        return np.linalg.eigvals(self.A)


def _plant(A, B, C, D=None) -> Plant:
    A, B, C = (np.array(M, dtype=float) for M in (A, B, C))
    return Plant(A, B, C, np.zeros((len(C), B.shape[1])) if D is None else np.array(D, float))


def _flexible_structure() -> Plant:
    """Three modes at 2, 5 and 9 Hz with 1 % damping, 2 inputs, 3 outputs of like size."""
    omega = 2 * np.pi * np.array([2.0, 5.0, 9.0])
    A, B, C = np.zeros((6, 6)), np.zeros((6, 2)), np.zeros((3, 6))
    A[0::2, 1::2], A[1::2, 0::2] = np.diag(omega), -np.diag(omega)
    A[1::2, 1::2] = -2 * 0.01 * np.diag(omega)
    B[1::2] = [[1.0, 0.5], [0.8, -1.0], [0.6, 0.7]]
    C[:, 0::2] = [[1.0, 0.7, 0.4], [0.5, -1.0, 0.8], [-0.6, 0.4, 1.0]]
    return _plant(A, B, C)


PLANTS = {
    # [HD] section 5.1: two real poles, -2 and -4; one input, two outputs.
    'hd51': _plant([[-2, 1], [0, -4]], [[0.5], [1]], [[1, 4], [2, 1]]),
    # [HD] section 5.2: longitudinal motion of a quadrotor, -5 and -1 +- i, with feedthrough.
    'hd52': _plant(
        [[-0.2588, 0.2115, -9.5751], [0.7629, -6.7412, -10.4169], [0, 1, 0]],
        [[-10.1647], [450.71], [0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.1068, 0.1192, 0]], [[0], [0], [0], [-10.1647]]),
    'flexible': _flexible_structure(),
    # Poles +2 and -3: has to be flown under a controller.
    'unstable': _plant([[0, 1], [6, -1]], [[0], [1]], [[1, 0]]),
}


@pytest.fixture
def plants() -> dict[str, Plant]:
    """Test plants by name: hd51, hd52, flexible, unstable."""
    return PLANTS


@pytest.fixture
def data_folder() -> Path:
    """Folder of the real recordings; the test is skipped where they are absent."""
    folder = Path(os.environ.get('CTSID_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip('real recordings are not here; name their folder in CTSID_DATA')
    return folder
