# SPDX-License-Identifier: Apache-2.0
"""Sampled signals, records, sliding windows; corrupt and stuck samples."""
