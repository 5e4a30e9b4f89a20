# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo studies of the estimator against published figures and the Cramer-Rao bound."""
