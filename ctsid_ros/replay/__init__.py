# SPDX-License-Identifier: Apache-2.0
"""Sliding windows along a bag, and the folder of results."""
