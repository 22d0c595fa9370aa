"""How Sphinx builds the site: `make docs`, without a network.

References:
    Sphinx, https://www.sphinx-doc.org; sphinx-gallery, https://sphinx-gallery.github.io; MyST,
    https://myst-parser.readthedocs.io.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from pydoc import locate
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]  # reading_order, coim
os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that wait for each other collapse beside other work
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL tells of each buffer otherwise
os.environ.setdefault("MUJOCO_GL", "egl")  # pictures without a screen; mujoco asks for it when it is imported

from docutils.nodes import Element  # noqa: E402
from sphinx.addnodes import pending_xref  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402
from sphinx.environment import BuildEnvironment  # noqa: E402
from sphinx.util import inspect  # noqa: E402
from sphinx.util.nodes import make_refnode  # noqa: E402

import coim  # noqa: E402

project, author, release = "coim", "The coim authors", coim.__version__
project_copyright = "2026, The coim authors"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # equations are drawn without a network too
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["build", "tutorials"]
templates_path = ["templates"]
nitpicky = True  # a reference that leads nowhere is a warning, and with -W an error

# -- the API reference ------------------------------------------------------------------------------------------------
default_role = "py:obj"  # docstrings name things in single backticks
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_use_ivar = True
napoleon_use_rtype = False


def first_line_is_text(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Keep napoleon from reading "paper: the protocol" below an attribute as the type ``paper`` and a text."""
    if what in ("attribute", "data", "property") and lines:
        lines[:0] = ["..", ""]  # an empty comment


def own_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Show what ``__init__`` takes where a metaclass of TorchRL hides it."""
    if what == "class" and signature == "(*args, **kwargs)":
        own = inspect.signature(obj.__init__, bound_method=True)
        signature = inspect.stringify_signature(own, show_return_annotation=False, unqualified_typehints=True)
    return signature, returns


def table_has_title(app: Sphinx, docname: str, source: list[str]) -> None:
    """Give the tables beside figures a title: pages do not get on without, and elsewhere they are parts of a page."""
    if not source[0].startswith("#") and docname.startswith("results/"):
        source[0] = f"# {Path(docname).name}\n\n{source[0]}"


def without_page(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: Element) -> Element | None:
    """Resolve a name that is public under a shorter one, and let names pass that exist without a page of their own.

    Other libraries have sites of their own, and no network is used to look names up there. A word in single backticks
    may be a parameter or a value. What is left is a mistake, and a warning.
    """
    if node.get("refdomain") != "py":
        return None
    target, module = node["reftarget"], node.get("py:module")
    parts = target.split(".")
    if module is None or len(parts) > 1 or "_" in target or target[0].isupper():  # "imagine" may be the setting
        for words in (parts, parts[-2:], parts[-1:]):
            found = env.domains.python_domain.find_obj(env, "", "", ".".join(["coim", *words]), None, 0)
            for name, entry in found[:1]:
                return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, name)
    return content if node["reftype"] == "obj" or exists(target, module, node.get("py:class")) else None


def exists(target: str, module: str | None, kind: str | None) -> bool:
    """Whether a name is that of something, seen from where it stands or from a module of ours."""
    ours = [name for name in sys.modules if name.split(".")[0] == "coim"]
    places = [module, f"{module}.{kind}", "collections.abc", *ours]
    return any(locate(name) is not None for name in (target, *(f"{place}.{target}" for place in places)))


def setup(app: Sphinx) -> None:
    """Take part in what Sphinx does."""
    app.connect("autodoc-process-docstring", first_line_is_text, priority=400)  # napoleon has 500
    app.connect("autodoc-process-signature", own_signature)
    app.connect("source-read", table_has_title)
    app.connect("missing-reference", without_page)


# Names that pydantic and typing put into signatures.
nitpick_ignore_regex = [
    ("py:class", r"(NoneType|FieldInfo|Field|Ge|Gt|Le|Lt|Strict|MinLen|.*Annotated|Positional|.*ValidationInfo)"),
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
    "backreferences_dir": None,
    "min_reported_time": 1,
    "capture_repr": (),
    "remove_config_comments": True,
}

# -- the pages' looks -------------------------------------------------------------------------------------------------
html_theme = "furo"
html_title = f"coim {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
mathjax_path = "mathjax/tex-chtml.js"
html_show_sphinx = False
