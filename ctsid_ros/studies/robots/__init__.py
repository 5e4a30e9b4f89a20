# SPDX-License-Identifier: Apache-2.0
"""The exam: simulated robots as they are recorded, and what an identification makes of them."""
