# SPDX-License-Identifier: Apache-2.0
"""Which experiment would make a model as accurate as it is wanted."""
