# SPDX-License-Identifier: Apache-2.0
"""Reports: sections, tables, drawings, rendered for terminal, Markdown and HTML."""
