# SPDX-License-Identifier: Apache-2.0
"""Arrays by what they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Lines = NDArray[np.complex128]  # spectral lines, one column per frequency
Mask = NDArray[np.bool_]
Places = NDArray[np.intp]
