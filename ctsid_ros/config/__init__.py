# SPDX-License-Identifier: Apache-2.0
"""Channels, parameter files, and what is written about parameters."""
