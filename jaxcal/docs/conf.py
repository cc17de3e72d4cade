"""Sphinx's configuration for the pages in this folder: `python -m sphinx -W jaxcal/docs OUT`."""

import importlib.metadata

project = "jaxcal"
author = "The jaxcal authors"
copyright = author
release = importlib.metadata.version("jaxcal")

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["README.md"]

html_theme = "furo"
html_title = f"jaxcal {release}"
html_static_path: list[str] = []
# Shapes and units are in the docstrings; the types' full names would fill the page.
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False, "exclude-members": "__init__, __new__"}
add_module_names = False
