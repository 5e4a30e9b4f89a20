# SPDX-License-Identifier: Apache-2.0
"""Matrices and numbers: what knows nothing of signals and models."""
