"""Configuration of the documentation site, which ``make docs`` builds."""

import sys
from pathlib import Path

import touchdown

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "_ext"))
import pages  # noqa: E402

project = "Touchdown"
author = "The Touchdown contributors"
copyright = f"2026, {author}"
release = version = touchdown.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "pages",
]
# Pages that `pages` writes have a suffix of their own, so that nobody takes them for sources.
source_suffix = {".md": "markdown", ".rst": "restructuredtext", ".myst": "markdown"}
root_doc = "index"
exclude_patterns = ["README.md", "gallery/**/*.ipynb", "gallery/**/*.py"]
templates_path = ["_templates"]
myst_heading_anchors = 6
nitpicky = True

# Inventories are files: the build needs no network. `_inventories/write.py` makes them.
intersphinx_mapping = {
    name: (address, f"_inventories/{name}.inv")
    for name, address in {
        "python": "https://docs.python.org/3/",
        "numpy": "https://numpy.org/doc/stable/",
        "scipy": "https://docs.scipy.org/doc/scipy/",
        "torch": "https://docs.pytorch.org/docs/stable/",
    }.items()
}

autosummary_generate = True
autosummary_context = {"members": pages.members()}
autosummary_ignore_module_all = False
autodoc_typehints = "none"  # the numpydoc sections state types, shapes and units
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {
    "ndarray": "numpy.ndarray",
    "Path": "pathlib.Path",
    **{name: f"touchdown.{name}" for name in touchdown.__all__},
}

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py",
    "within_subsection_order": "FileNameSortKey",
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("touchdown",),
    "reference_url": {"touchdown": None},
    "show_memory": False,
    "min_reported_time": 0,
    "download_all_examples": False,
    "remove_config_comments": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "Touchdown"
html_logo = html_favicon = "../resources/icons/touchdown.svg"
html_theme_options = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 7,
}
html_show_sourcelink = False
linkcheck_timeout = 20
