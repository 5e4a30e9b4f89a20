# SPDX-License-Identifier: Apache-2.0
"""Subspace methods; `methods.py` is the table of all."""
