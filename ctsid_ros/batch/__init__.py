# SPDX-License-Identifier: Apache-2.0
"""Many bags: each a task of its own, on a cluster, and a table and a page over all."""
