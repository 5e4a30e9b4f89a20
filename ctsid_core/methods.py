# SPDX-License-Identifier: Apache-2.0
"""
The methods beside HD-PBSID, by the name that `Settings.method` gives them.

A method is a function in a file of its own, a row here, and its name among the choices of
`Settings.method`.
"""

from __future__ import annotations

from ctsid_core import ct_pbsid, gobf
from ctsid_core.other_method import Method

METHODS: dict[str, Method] = {
    'ct-pbsid': ct_pbsid.by_projection,
    'ct-pbsid-filter': ct_pbsid.by_filtering,
    'gobf': gobf.by_bases,
}
