"""Settings of Sphinx for the guide, the gallery and the pages of public names; ``build.py`` uses them."""

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parents[1])]  # sphinx_hooks, and this checkout's holotorch

from holotorch import __version__  # noqa: E402

project = "holotorch"
version = release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "sphinx_hooks",
]
myst_heading_anchors = 3
default_role = "code"

nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(torch|numpy|collections|enum|asyncio)\..*"),  # other projects, whose inventories are not fetched
    ("py:.*", r"holotorch\.[\w.]*\._\w+"),  # private bases
    (
        "py:class",
        r"holotorch\..*\.(Nodes|Axis|EndCheck|Sampler|Line|Argument)|holotorch\.tracking\.camera\.numpy_lens\.Lens",
    ),
]
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autosummary_generate = False
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_attr_annotations, napoleon_use_ivar = False, True  # attributes of a data class are listed once
python_use_unqualified_type_names = True

sphinx_gallery_conf = {
    "examples_dirs": ["../gallery"],  # beside this folder's copy, see build.py
    "gallery_dirs": ["gallery"],
    "filename_pattern": "",
    "image_scrapers": ("sphinx_hooks.picture_of_script",),
    "reset_modules": (),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "write_computation_times": False,
    "show_signature": False,
    "min_reported_time": 1e9,
}

html_theme = "alabaster"
html_static_path = [str(FOLDER / "static")]
html_css_files = ["guide.css"]
html_title = f"holotorch {version}"
html_copy_source = html_show_sphinx = html_show_copyright = False
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}
html_theme_options = {"description": "Differentiable optics for VR and AR displays, in PyTorch", "fixed_sidebar": False}
