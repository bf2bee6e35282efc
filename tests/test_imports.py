"""What imports what: no circles between files or folders, and every declared dependency is used."""

import ast
import re
import tomllib
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from paths import PACKAGE, ROOT

FILES = sorted(PACKAGE.rglob("*.py"))
# Rooms of a package: each may use those after it; names on one level do not import each other.
ROOMS = {
    "optics": [{"light"}, {"viewing"}, {"elements", "planning"}, {"free_space"}],
    "tracking": [
        {"thesis", "evaluation", "streaming", "simulation"},
        {"detection"},
        {"refinement"},
        {"pose"},
        {"camera"},
    ],
    "experiments": [
        {"measure", "view", "devices"},
        {"panel", "sweep", "pec_study", "scaling", "stability", "tracking_benchmark", "streaming"},
        {"joint"},
        {"eye"},
        {"camera", "network", "pec", "volume", "perception", "propagation", "tracking"},
        {"runs", "web"},
        {"planning"},
        {"config"},
    ],
}
# What a distribution is imported as, where that differs from its name.
IMPORTED_AS = {
    "opencv-contrib-python-headless": "cv2",
    "scikit-image": "skimage",
    "colour-science": "colour",
    "pyyaml": "yaml",
    "openexr": "OpenEXR",
    "pillow": "PIL",
    "pynrrd": "nrrd",
}


@dataclass(frozen=True)
class Source:
    """What the tests ask of a file: the modules that it imports, in functions too, and its functions of 80 lines.

    Of imports, those that only type checkers see are left out.
    """

    imported: set[str]
    long: tuple[str, ...]


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


@cache
def source(path: Path) -> Source:
    found, long = set[str](), list[str]()
    pending: list[ast.AST] = [ast.parse(path.read_text())]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= 80:
            long.append(f"{path.relative_to(PACKAGE)}: {node.name}")
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & MODULES.keys()
            if not inner <= MODULES.keys():
                found.add(node.module)
        pending += ast.iter_child_nodes(node)
    return Source(found, tuple(long))


GRAPH = {module: source(path).imported & MODULES.keys() - {module} for module, path in MODULES.items()}


def folder_of(module: str) -> str:
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


def circle(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_circles_are_found():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}}) and not circle({"a": {"b", "c"}, "b": {"c"}, "c": set()})


def test_no_files_import_each_other():
    assert not circle(GRAPH)


def test_no_folders_import_each_other():
    folders: dict[str, set[str]] = defaultdict(set)
    for module, used in GRAPH.items():
        # What a package offers under its own name is gathered from its modules and sub-folders.
        if MODULES[module].name != "__init__.py":
            folders[folder_of(module)] |= {folder_of(other) for other in used if other != "holotorch"} - {
                folder_of(module)
            }
    assert not circle(folders)


def test_folders_can_be_taken_in_at_a_glance():
    sizes = Counter(module_of(path.parent / "__init__.py") for path in FILES)
    assert not {folder: size for folder, size in sizes.items() if size > 14}


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_of_a_package_use_each_other_one_way(package):
    prefix = f"holotorch.{package}."
    level = {room: i for i, rooms in enumerate(ROOMS[package]) for room in rooms}
    assert {path.name for path in (PACKAGE / package).iterdir() if (path / "__init__.py").is_file()} == level.keys()
    for module, used in GRAPH.items():
        room = module.removeprefix(prefix).partition(".")[0]
        for other in used if module.startswith(prefix) and room in level else ():
            there = other.removeprefix(prefix).partition(".")[0]
            if other.startswith(prefix) and there in level and there != room:
                assert level[there] > level[room], f"{module} imports {other}: sideways or upwards"


def test_an_experiment_is_found_through_the_registry_alone():
    """No file outside of its folder, and no branch of the command line, names the module of a kind."""
    kinds = {module for module in MODULES if module.endswith(".kind") and module != "holotorch.experiments.kind"}
    assert len(kinds) >= 6
    assert not [(module, used) for module, others in GRAPH.items() for used in others & kinds]
    assert "settings.experiment ==" not in MODULES["holotorch.cli"].read_text()


@pytest.mark.parametrize("group", ["", "stats", "volumes", "slicer", "lpips", "bench"])
def test_declared_dependencies_are_imported(group):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed = project["optional-dependencies"][group] if group else project["dependencies"]
    sources = [*FILES, ROOT / "scripts" / "bench.py"] if group == "bench" else FILES
    text = "".join(path.read_text() for path in FILES)
    everything = {name.split(".")[0] for path in sources for name in source(path).imported}
    for requirement in listed:
        name = re.split(r"[<>=~!;\[ ]", requirement)[0].lower()
        optional = f'"{name}"' in text  # by its name, where it is installed
        assert IMPORTED_AS.get(name, name) in everything or optional, requirement


def test_a_function_fits_on_a_screen():
    assert [name for path in FILES for name in source(path).long] == []
