# SPDX-License-Identifier: Apache-2.0
"""
Sphinx configuration: `make docs`, or rosdoc2, which executes this text from another folder.

Hence nothing here depends on where this file is. rosdoc2 brings a theme of its own.
"""

import re

project = 'ctsid'
author = 'The ctsid developers'
copyright = author  # noqa: A001  # Sphinx asks for this name
version = release = '0.1.0'

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
master_doc = 'index'
exclude_patterns = ['cpp']

# Links like method.md#limits go to headings, as they do where Markdown is shown as it is.
myst_heading_anchors = 3
smartquotes = False  # -- is part of commands

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings have them
napoleon_google_docstring = False
napoleon_use_param = napoleon_use_rtype = False  # no links to words such as ndarray

html_theme = 'furo'
html_title = f'ctsid {release}'
html_static_path = ['_static']
html_css_files = ['tables.css']
html_copy_source = False
html_show_sphinx = False


def titles(app, name, source):
    """Give links that are named like their file the title of the page: [](method.md)."""
    source[0] = re.sub(r'\[(\w+\.md)\]\((\1[#)])', r'[](\2', source[0])


def setup(app):
    """Called by Sphinx."""
    app.connect('source-read', titles)
