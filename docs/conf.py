"""The documentation site: pages in MyST Markdown, the API from the docstrings."""

from __future__ import annotations

import inspect
import os

os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")

from sphinx.util.inspect import stringify_signature

from torchrl_bmrl import __version__

project = "torchrl_bmrl"
author = "The torchrl_bmrl authors"
copyright = f"2026, {author}"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Offline skills for TorchRL",
    "fixed_sidebar": True,
    "page_width": "72rem",
    "sidebar_width": "16rem",
}
html_show_sourcelink = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_default_options = {"show-inheritance": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True

# sphinx-build -t offline: without links into other projects' pages, whose index it would fetch.
if not tags.has("offline"):  # noqa: F821 (Sphinx brings it)
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "tensordict": ("https://docs.pytorch.org/tensordict/stable", None),
        "torchrl": ("https://docs.pytorch.org/rl/stable", None),
    }


def constructor(app, what, name, obj, options, signature, returned):
    """A class's own signature, where TorchRL's metaclasses show theirs, ``(*args, ...)``."""
    if what != "class" or not (signature or "").startswith("(*args"):
        return None
    own = inspect.signature(obj.__init__)
    own = own.replace(
        parameters=list(own.parameters.values())[1:], return_annotation=inspect.Signature.empty
    )
    return stringify_signature(own), None


def setup(app):
    """Sphinx calls it."""
    app.connect("autodoc-process-signature", constructor)
