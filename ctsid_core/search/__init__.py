# SPDX-License-Identifier: Apache-2.0
"""From projections to a model: starts, order, dead time, noise, parts held out."""
