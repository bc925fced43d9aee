"""Sphinx: ``make doc`` builds these pages into docs/_build/html."""

import importlib.util
import pathlib
import re

import sb3_eqr

DOCS = pathlib.Path(__file__).parent

project = "sb3_eqr"
author = "the sb3_eqr developers"
copyright = "the sb3_eqr developers, MIT licence"
release = version = sb3_eqr.__version__

extensions = [
    "myst_nb",  # Markdown pages, and the notebooks with the outputs that they were saved with
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas without a network
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_title = f"sb3_eqr {release}"

# Pages are read on GitHub as well: $...$ are formulas in both, `#heading` works in links in both.
myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # make tutorials executes them

# Docstrings are reST with `:param x:`; types come from the signatures.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 80
# What the pages import beside the package's own dependencies: stand-ins where it is not installed.
autodoc_mock_imports = [name for name in ("ale_py", "cv2", "yaml") if importlib.util.find_spec(name) is None]

copybutton_exclude = ".linenos, .gp, .go"  # comments in commands are copied, prompts and outputs are not


def unlink_outside(app, docname, source):
    """
    Links to files outside docs/ become downloads by themselves. A link to a folder or a page there works on GitHub only: here
    its text and path stay.
    """
    folder = (DOCS / docname).parent

    def text_of(match: re.Match) -> str:
        target = (folder / match[2]).resolve()
        is_dead = not target.is_relative_to(DOCS) and (target.is_dir() or target.suffix == ".md")
        return f"{match[1]} (`{target.relative_to(DOCS.parent)}`)" if is_dead else match[0]

    source[0] = re.sub(r"\[([^\]]+)\]\((\.\./[^)#]*)\)", text_of, source[0])


def escape_shapes(app, what, name, obj, options, lines):
    """The star in a shape such as (B, *obs_shape) is no emphasis."""
    lines[:] = [re.sub(r"(?<=[ (])\*(?=\w+[,)])", r"\\*", line) for line in lines]


def setup(app):
    """Called by Sphinx."""
    app.connect("source-read", unlink_outside)
    app.connect("autodoc-process-docstring", escape_shapes)
