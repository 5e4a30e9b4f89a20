# SPDX-License-Identifier: Apache-2.0
"""Models of consecutive windows as one moving model."""
