# SPDX-License-Identifier: Apache-2.0
"""Field paths, and the scalars that they name in serialised messages."""
