"""How Sphinx makes the documentation's pages: ``make docs``."""

import os
from importlib.metadata import version as version_of
from pathlib import Path

project = "ejector-twin"
version = release = version_of("ejector-twin")
extensions = ["myst_nb", "sphinx.ext.autodoc"]
myst_heading_anchors = 3  # [there](page.md#a-heading) works as it does elsewhere
myst_url_schemes = ("http", "https")
# Notebooks are run anew with each build, by the program as it is; a failing cell fails the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = -1  # a cell may have to compile first, on a busy machine
nb_output_stderr = "remove"  # that something is compiled
os.environ["PYTHONPATH"] = str(Path(__file__).parents[1])  # kernels import the tools, too
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
html_theme = "furo"  # brings all it needs: pages are read from a disk, without a network
html_title = f"ejector-twin {version}"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
