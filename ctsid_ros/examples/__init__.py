# SPDX-License-Identifier: Apache-2.0
"""Examples to run and to copy from: a simulated robot, and a node that tunes its controller."""
