# SPDX-License-Identifier: Apache-2.0
"""Likelihoods of lines and of samples, their maxima, and the information in them."""
