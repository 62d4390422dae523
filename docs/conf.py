"""Sphinx configuration; the source folder is the root of the repository, so that links work as on a code host."""

import os
from pathlib import Path

from ecu_node import __version__

project = "hv-current-correction"
author = "the authors of hv-current-correction"
version = release = __version__
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "deploy/README.md",
    "docs/**.md",
    "docs/reference/api/*.rst",
    "docs/gallery/*.rst",
    "examples/*.ipynb",
]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "docs_site.command_reference",
    "docs_site.docstrings",
    "docs_site.mathml",
]

highlight_language = "text"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_show_tb = True  # a failure is a warning, and so an error
nb_execution_timeout = 1800  # s for a cell; on a busy machine, with the estimator compiled anew
nb_merge_streams = True
nb_output_stderr = "remove"  # progress; warnings are errors
os.environ["PYTHONWARNINGS"] = "error,ignore::PendingDeprecationWarning"  # in examples; the latter is of their kernel

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "docs/gallery",
    "within_subsection_order": "docs_site.GalleryOrder",
    "default_thumb_file": "docs/images/kirchhoff.png",
    "filename_pattern": r"\.py$",  # all of them run
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
}

autodoc_typehints = "none"  # types stand in the docstrings, with shapes and units
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
napoleon_use_param = napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]

nitpicky = True  # functions and exceptions that a docstring names are on these pages; not all modules and constants are
nitpick_ignore_regex = [("py:(class|data|mod)", ".*")]

templates_path = [str(Path(__file__).parent / "templates")]
html_theme = "furo"
html_title = f"{project} {version}"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["static/index.html"]
html_copy_source = html_show_sourcelink = html_show_copyright = False
