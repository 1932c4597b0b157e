"""Sphinx: python -m pip install '.[docs]' && sphinx-build -W --keep-going docs build/site"""

from __future__ import annotations

from limbfit import __version__

project = "limbfit"
author = project_copyright = "The limbfit developers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
html_theme = "pydata_sphinx_theme"
html_title = f"limbfit {release}"
html_theme_options = {"navigation_depth": 2, "show_toc_level": 2}
myst_heading_anchors = 4
# Pages link to files of the repository that are no pages of the site, the examples above all.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "description"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Array": "Array"}
autodoc_member_order = "bysource"
