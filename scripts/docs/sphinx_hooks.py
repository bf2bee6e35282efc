"""What Sphinx does here beyond its settings: plain docstrings, links from names in code type, pictures of scripts."""

import re
import shutil
import sys
from dataclasses import is_dataclass
from enum import Enum
from functools import lru_cache
from importlib import import_module
from inspect import getsource, isroutine
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import desc, desc_parameter, desc_signature, pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext import autosummary
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode
from sphinx_gallery.scrapers import figure_rst

autosummary.WELL_KNOWN_ABBREVIATIONS += ("Alg.", "Eq.", "Eqs.", "Fig.", "Figs.", "Sec.")  # end no sentence

_SHORT = 26  # letters of a word in code type that fits on a phone's line: it is not broken


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect everything of this module."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", describe_fields, priority=50)
    app.connect("autodoc-process-docstring", escape_formulas, priority=100)  # before napoleon makes markup of it
    app.connect("autodoc-process-signature", shorten_defaults)
    app.connect("autodoc-process-bases", without_private_bases)
    app.connect("missing-reference", resolve_by_last_name)
    app.connect("doctree-resolved", link_names_in_code_type)
    app.connect("doctree-resolved", link_pictures)
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
        """Table and docstrings of the objects of these full names, and the constants, as reStructuredText."""
        objects = {name: getattr(import_module(name.rpartition(".")[0]), name.rpartition(".")[2]) for name in names}
        constants = {name for name, member in objects.items() if not isinstance(member, type) and not isroutine(member)}
        listed = [f"   ~{name}" for name in names if name not in constants]
        lines = [".. autosummary::", "", *listed, ""] if listed else []
        for name, member in objects.items():
            if name in constants:
                lines += constant(name, member)
            else:
                kind = "class" if isinstance(member, type) else "function"
                lines += [f".. auto{kind}:: {name}", *(options(member) if isinstance(member, type) else ()), ""]
        return lines


def options(cls: type) -> list[str]:
    """Options of autodoc for a class: members, its own call, and the names of an enumeration."""
    lines = ["   :show-inheritance:"] if any(map(is_public_base, cls.__bases__)) else []
    if not issubclass(cls, tuple):  # the fields of a named tuple are in its docstring
        lines.append("   :members:")
    if issubclass(cls, Enum):
        lines.append("   :undoc-members:")
    calls = next((base for base in cls.__mro__ if "__call__" in vars(base)), object)
    if calls.__module__.startswith("holotorch."):
        lines.append("   :special-members: __call__")
    return lines


def constant(name: str, value: object) -> list[str]:
    """A constant with its value, if that is short, and the comment beside or above it."""
    package, _, last = name.rpartition(".")
    text = ""
    for module in [each for key, each in sys.modules.items() if key.startswith(package)]:
        if vars(module).get(last) is value:
            pattern = rf"((?:^# .*\n)*)^(?:\w+, )*{last}\b[^=\n]*= ([^\n]*)$"
            if match := re.search(pattern, getsource(module), re.MULTILINE):
                above = " ".join(line.removeprefix("# ") for line in match[1].splitlines())
                text = " ".join(filter(None, [above, match[2].partition("  # ")[2]])).strip()
    short = repr(value) if len(repr(value)) < 100 else ""
    shown = [f"   :value: {short}"] if short else []
    text = re.sub(r"([*|])", r"\\\1", text[:1].upper() + text[1:])
    return [f".. py:data:: {last}", f"   :module: {package}", *shown, "", f"   {text}", ""]


def describe_fields(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Fields of a data class whose docstring does not list them are described by the comments beside or above them."""
    if not (isinstance(obj, type) and is_dataclass(obj)) or {"Attributes:", "Args:"} & set(lines):
        return
    described, above = [], []
    for line in getsource(obj).splitlines():
        comment = line.partition("  # ")[2] if not line.startswith("    # ") else line.removeprefix("    # ")
        if line.startswith("    # "):
            above.append(comment)
        elif (match := re.match(r"    (\w+): ", line)) and match[1] in obj.__dataclass_fields__:
            if text := " ".join(filter(None, [*above, comment])):
                described.append(f"    {match[1]}: {text[0].upper()}{text[1:]}.")
            above = []
    if described:
        lines += ["", "Attributes:", *described, ""]


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


def without_private_bases(app: Sphinx, name: str, obj: object, options: object, bases: list[type]) -> None:
    """Bases that no page documents say nothing to a reader."""
    bases[:] = filter(is_public_base, bases)


def is_public_base(base: type) -> bool:
    """Whether a base class is worth a line."""
    return base is not object and not getattr(base, "__name__", "").startswith("_")


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
        if max(map(len, literal.astext().split()), default=0) <= _SHORT:
            literal["classes"].append("short")
        inside, name = literal.parent, re.sub(r"\(.*\)$", "", literal.astext())
        while inside is not None and not isinstance(inside, nodes.reference | desc_signature | nodes.title):
            if isinstance(inside, desc) and name in parameters(inside):
                break
            inside = inside.parent
        if inside is None and len(places.get(name, [])) == 1:
            there, anchor = places[name][0]
            literal.replace_self(make_refnode(app.builder, page, there, anchor, literal.deepcopy(), anchor))


def parameters(described: desc) -> set[str]:
    """Names of the parameters of what is described; a docstring means these, not what else is called so."""
    signatures = [each for each in described.children if isinstance(each, desc_signature)]
    written = [each.astext() for signature in signatures for each in signature.findall(desc_parameter)]
    return {re.split("[:=]", text)[0].strip("* ") for text in written}


def link_pictures(app: Sphinx, tree: nodes.document, page: str) -> None:
    """A picture leads to its file, which a browser shows at full size: charts are too fine for the width of a page."""
    up = "../" * page.count("/")
    for picture in list(tree.findall(nodes.image)):
        name = app.env.images.get(picture["uri"], (set(), ""))[1]
        if name and not isinstance(picture.parent, nodes.reference):
            link = nodes.reference("", "", refuri=f"{up}_images/{name}", internal=True)
            picture.replace_self(link)
            link += picture


def picture_of_script(block: Any, values: dict[str, Any], settings: dict[str, Any]) -> str:
    """Picture beside a script of the gallery, which the script has just written or which is committed."""
    target = next(values["image_path_iterator"])
    shutil.copyfile(Path(values["src_file"]).with_suffix(".png"), target)
    return figure_rst([target], settings["src_dir"])
