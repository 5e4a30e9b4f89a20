# SPDX-License-Identifier: Apache-2.0
"""
THE table of methods, by the name that `Settings.method` gives them.

A method is a function in a file of its own, a row here, and its name among the choices of
`Settings.method`. What is particular to a method stands in its row and nowhere else.
"""

from __future__ import annotations

from ctsid_core.subspace import ct_pbsid, gobf, hd_pbsid
from ctsid_core.subspace.interface import Method

METHODS: dict[str, Method] = {
    'hd-pbsid': Method(hd_pbsid.by_lines, refines=True),
    'ct-pbsid': Method(ct_pbsid.by_projection),
    'gobf': Method(gobf.by_bases),
}
