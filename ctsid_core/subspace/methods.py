# SPDX-License-Identifier: Apache-2.0
"""
THE table of methods, by the name that `Settings.method` gives them.

A method is a function in a file of its own, a row here, and its name among the choices of
`Settings.method`. What is particular to a method stands in its row and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from ctsid_core.bases.records import Joint
from ctsid_core.settings import Settings
from ctsid_core.subspace import ct_pbsid, gobf, hd_pbsid
from ctsid_core.subspace.hd_pbsid import MethodModel


@dataclass(frozen=True)
class Method:
    """A row of the table of methods."""

    # From the records, the settings, the orders that are wanted and what is called often to all
    # models that the method has to offer: of every order and every tuning that the settings leave
    # open. Orders that the data are too short for are left out.
    models: Callable[[Joint, Settings, Sequence[int], Callable[[], None]], Iterator[MethodModel]]
    # Whether its models are taken to the maximum of the likelihood, with dead times that are not
    # given; else they stay as they are made, the likeliest is taken, and those count as 0.
    refines: bool = False


METHODS: dict[str, Method] = {
    'hd-pbsid': Method(hd_pbsid.by_lines, refines=True),
    'ct-pbsid': Method(ct_pbsid.by_projection),
    'gobf': Method(gobf.by_bases),
}
