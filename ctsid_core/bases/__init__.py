# SPDX-License-Identifier: Apache-2.0
"""From records to projections: lines of a basis in which the derivative is diagonal."""
