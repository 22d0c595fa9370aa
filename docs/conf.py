"""How Sphinx builds the site: `make docs`, without a network.

References:
    Sphinx, https://www.sphinx-doc.org; sphinx-gallery, https://sphinx-gallery.github.io; MyST,
    https://myst-parser.readthedocs.io.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]  # reading_order, coim
os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that wait for each other collapse beside other work
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL tells of each buffer otherwise
os.environ.setdefault("MUJOCO_GL", "egl")  # pictures without a screen; mujoco asks for it when it is imported

import coim  # noqa: E402

project, author, release = "coim", "The coim authors", coim.__version__
project_copyright = "2026, The coim authors"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["build", "tutorials", "README.md"]
templates_path = ["templates"]
nitpicky = True  # a reference that leads nowhere is a warning, and with -W an error

# -- the API reference ------------------------------------------------------------------------------------------------
default_role = "py:obj"  # docstrings name things in single backticks
rst_prolog = ".. py:currentmodule:: coim\n"
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_use_ivar = True
napoleon_use_rtype = False
# Other libraries have sites of their own, and no network is used to look names up there.
OTHERS = "torch|torchrl|tensordict|mujoco|numpy|np|pandas|pd|scipy|matplotlib|gymnasium|pyswarms|botorch|gpytorch"
nitpick_ignore_regex = [
    ("py:.*", rf"({OTHERS})(\..*)?"),
]

# -- pages in Markdown ------------------------------------------------------------------------------------------------
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# -- tutorials --------------------------------------------------------------------------------------------------------
sphinx_gallery_conf = {
    "examples_dirs": ["tutorials"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "reading_order.ReadingOrder",
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
    "abort_on_example_error": True,
    "doc_module": ("coim",),
    "backreferences_dir": None,
    "min_reported_time": 1,
}

# -- the pages' looks -------------------------------------------------------------------------------------------------
html_theme = "furo"
html_title = f"coim {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
