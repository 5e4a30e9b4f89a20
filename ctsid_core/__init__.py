# SPDX-License-Identifier: Apache-2.0
"""ctsid: continuous-time state-space models from irregularly sampled signals."""
