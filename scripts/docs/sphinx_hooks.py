"""What Sphinx does here beyond its settings: plain docstrings, links from names in code type, pictures of scripts."""

import re
import shutil
from functools import lru_cache
from importlib import import_module
from inspect import isroutine
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import desc_signature, pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode
from sphinx_gallery.scrapers import figure_rst


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect everything of this module."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", escape_formulas, priority=100)  # before napoleon makes markup of it
    app.connect("autodoc-process-signature", shorten_defaults)
    app.connect("missing-reference", resolve_by_last_name)
    app.connect("doctree-resolved", link_names_in_code_type)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class PublicNames(SphinxDirective):
    """A table of what a package lists in ``__all__``, and the docstrings: ``.. public-names:: holotorch.optics``.

    The content, if any, are the full names of what else is worth a place on the page.
    """

    optional_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Let autosummary and autodoc do it."""
        package = self.arguments[0] if self.arguments else None
        public = [f"{package}.{name}" for name in import_module(package).__all__] if package else []
        further = list(self.content)
        lines = self._section(public)
        if public and further:
            lines += [".. rubric:: What else these take, return and rely on", ""]
        return self.parse_text_to_nodes("\n".join(lines + self._section(further)))

    def _section(self, names: list[str]) -> list[str]:
        """Table and docstrings of the objects of these full names, as reStructuredText."""
        lines = [".. autosummary::", "", *(f"   ~{name}" for name in names), ""] if names else []
        for name in names:
            found = getattr(import_module(name.rpartition(".")[0]), name.rpartition(".")[2])
            kind = "class" if isinstance(found, type) else "function" if isroutine(found) else "data"
            options = {"class": ["   :members:", "   :show-inheritance:"], "data": ["   :no-value:"]}.get(kind, [])
            lines += [f".. auto{kind}:: {name}", *options, ""]
        return lines


def escape_formulas(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """In docstrings ``*`` multiplies and ``|`` is a magnitude: neither is markup."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)
        lines[i] = "".join(part if part.startswith("``") else re.sub(r"([*|])", r"\\\1", part) for part in parts)


def shorten_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Defaults that are no Python, such as ``<factory>`` of a data class, become an ellipsis."""
    return re.sub(r"<[^<>]*>", "...", signature) if signature else signature, returns


def documented(env: BuildEnvironment) -> dict[str, list[tuple[str, str]]]:
    """Page and anchor of every documented object, by its full name and by the last part (of methods: two parts)."""
    return _documented(env, len(env.domains.python_domain.objects))


@lru_cache(maxsize=1)  # every reference asks for it
def _documented(env: BuildEnvironment, count: int) -> dict[str, list[tuple[str, str]]]:
    """:func:`documented` for ``count`` objects."""
    places: dict[str, list[tuple[str, str]]] = {}
    for name, entry in env.domains.python_domain.objects.items():
        parts = 2 if entry.objtype in ("method", "attribute", "property") else 1
        for key in {name, ".".join(name.split(".")[-parts:])}:
            if (place := (entry.docname, entry.node_id)) not in places.setdefault(key, []):
                places[key].append(place)
    return places


def resolve_by_last_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.reference | None:
    """A docstring names what lies near it by the last part of its name; what lies in its own package comes first."""
    places = documented(env).get(node["reftarget"], []) if node.get("refdomain") == "py" else []
    near = [place for place in places if place[0] == node["refdoc"]] or places
    return make_refnode(app.builder, node["refdoc"], *near[0], content, near[0][1]) if len(near) == 1 else None


def link_names_in_code_type(app: Sphinx, tree: nodes.document, page: str) -> None:
    """A public name in code type leads to its docstring, in Markdown as well, which needs no markup for it."""
    places = documented(app.env)
    for literal in list(tree.findall(nodes.literal)):
        inside = literal.parent
        while inside is not None and not isinstance(inside, nodes.reference | desc_signature | nodes.title):
            inside = inside.parent
        name = re.sub(r"\(.*\)$", "", literal.astext())
        if inside is None and len(places.get(name, [])) == 1:
            there, anchor = places[name][0]
            literal.replace_self(make_refnode(app.builder, page, there, anchor, literal.deepcopy(), anchor))


def picture_of_script(block: Any, values: dict[str, Any], settings: dict[str, Any]) -> str:
    """Picture beside a script of the gallery, which the script has just written or which is committed."""
    target = next(values["image_path_iterator"])
    shutil.copyfile(Path(values["src_file"]).with_suffix(".png"), target)
    return figure_rst([target], settings["src_dir"])
