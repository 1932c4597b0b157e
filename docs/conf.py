"""Sphinx: python -m pip install '.[docs]' && sphinx-build -W --keep-going docs build/site"""

from __future__ import annotations

import os
from ctypes.util import find_library

from limbfit import __version__

project = "limbfit"
author = project_copyright = "The limbfit developers"
release = version = __version__

extensions = [
    "myst_nb",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
html_theme = "pydata_sphinx_theme"
html_title = f"limbfit {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_depth": 2, "show_toc_level": 2}
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# The pages of docs/notebooks are run by every build; one that fails, fails the build.
os.environ |= {
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    "PYVISTA_JUPYTER_BACKEND": "static",
    "PYVISTA_OFF_SCREEN": "true",
}
if not os.environ.get("DISPLAY") and find_library("EGL"):  # else VTK looks for a display first, and says so
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

# Pages link to files of the repository that are no pages of the site, the examples above all.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "description"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Array": "Array"}
autodoc_member_order = "bysource"
