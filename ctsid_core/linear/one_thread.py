# SPDX-License-Identifier: Apache-2.0
"""
One thread of BLAS, while a model is identified.

The matrices are small: several threads wait for each other, which takes twice the time and five
times the processor, and the last digits depend on how many there are.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
import os
from typing import Any

VARIABLES = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')


def one_thread() -> AbstractContextManager[Any]:
    """
    Return a context in which BLAS has one thread, and after which it has as many as before.

    It is of the process: BLAS of other threads has one as long, too. Where several threads
    identify at once, it ends with the first of them; before version 3.8 of threadpoolctl BLAS may
    keep one thread then. Without that package nothing is limited.
    """
    # Programs of ours say so before BLAS is loaded; to look for libraries would lose a Ctrl-C.
    said = all(os.environ.get(name) == '1' for name in VARIABLES)
    libraries = None if said else _libraries()
    return nullcontext() if libraries is None else libraries.limit(limits=1, user_api='blas')


@cache
def _libraries() -> Any:    # noqa: ANN401 - of a library without types
    """Return what limits the libraries that are loaded, or None."""
    with suppress(ImportError):
        from threadpoolctl import ThreadpoolController

        return ThreadpoolController()
    return None
