# SPDX-License-Identifier: Apache-2.0
"""Bags: one reader for every format, what is in them, and records out of them."""
