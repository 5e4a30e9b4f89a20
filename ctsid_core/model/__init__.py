# SPDX-License-Identifier: Apache-2.0
"""State-space models: response, realisation, covariance; estimates and their files."""
