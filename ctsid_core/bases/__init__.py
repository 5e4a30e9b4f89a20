# SPDX-License-Identifier: Apache-2.0
"""Bases on which records are projected."""
