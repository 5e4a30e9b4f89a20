# SPDX-License-Identifier: Apache-2.0
"""Sampled signals, records, sliding windows; corrupt samples, and such that stand still."""
