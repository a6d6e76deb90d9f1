"""Settings of the documentation's site: `python -m sphinx -W -b html docs build/site`."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from pages import address  # noqa: E402

from dejavu_torch import __version__  # noqa: E402

project = "dejavu_torch"
copyright = "the dejavu_torch developers"
version = release = __version__

# pages.py, beside this file, writes the reference and keeps links the same as on GitHub
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "pages"]
html_theme = "furo"
html_title = "dejavu_torch"
html_baseurl = address("Documentation")
html_static_path, html_css_files = ["_static"], ["site.css"]
html_copy_source = False

myst_heading_anchors = 6  # as GitHub makes them
nb_execution_mode = "off"

default_role = "py:obj"  # `name` in a docstring
autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_inherit_docstrings = False  # nn.Module's own say nothing of these
autodoc_typehints_format = "short"
viewcode_follow_imported_members = False
add_module_names = False  # a heading has them
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
