"""How Sphinx makes the documentation's pages: ``make docs``."""

from importlib.metadata import version as version_of

project = "ejector-twin"
version = release = version_of("ejector-twin")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 3  # [there](page.md#a-heading) works as it does elsewhere
myst_url_schemes = ("http", "https")
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
html_theme = "furo"  # brings all it needs: pages are read from a disk, without a network
html_title = f"ejector-twin {version}"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
