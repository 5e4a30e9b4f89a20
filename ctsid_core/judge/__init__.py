# SPDX-License-Identifier: Apache-2.0
"""From a model to a verdict: evidence, tests, rules; the only place that grades."""
