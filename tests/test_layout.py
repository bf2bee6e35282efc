"""The house rules that a reader relies on: import directions, stable names, a README that runs."""

import ast
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from apart import printed_by
from paths import PACKAGE, ROOT

# Each level may use those after it and itself; names on one level do not import each other.
LEVELS = [
    {"__main__"},
    {"cli"},
    {"experiments"},
    {"io"},
    {"hologram", "correction", "plot"},
    {"scene", "modulator", "optics", "tracking", "perception", "metrics"},
    {"core"},
    {"__init__"},
]
ONLY_IN = {
    "kornia": {"tracking", "metrics"},
    "yaml": {"experiments"},
    "matplotlib": {"experiments", "plot"},
    "pydantic": {"experiments"},
    "aiohttp": {"experiments"},
    "cv2": {"io", "tracking"},
    "OpenEXR": {"io", "experiments"},
}


def level(part: str) -> int:
    return next(i for i, parts in enumerate(LEVELS) if part in parts)


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


FILES = sorted(PACKAGE.rglob("*.py"))


def test_imports_point_one_way():
    for path in FILES:
        part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for name in imports(path) if part != "__init__" else ():
            top, *rest = name.split(".")
            if top in ONLY_IN and path.name != "thesis_opencv.py":  # the baseline is OpenCV's by definition
                assert part in ONLY_IN[top], f"{path} imports {name}, which belongs to {ONLY_IN[top]}"
            if top != "holotorch" or not rest or rest[0] == part:
                continue
            assert level(rest[0]) > level(part), f"{path} imports {name}: sideways or upwards"
            if part == "correction":
                assert rest[0] == "core", f"{path} imports {name}: operators reach correction as arguments"


def test_planar_transforms_are_those_of_core():
    """Scaled ones are wrong at 2048 x 2048 on some CPUs; core.fourier knows the way around."""
    others = [path for path in FILES if path.parent.name not in ("core", "propagation") and path.name != "doctor.py"]
    assert [path for path in others if re.search(r"torch\.fft\.\w*fft2", path.read_text())] == []


@pytest.mark.parametrize("path", sorted((ROOT / "tests" / "oracles").glob("*.py")), ids=lambda path: path.name)
def test_oracles_know_nothing_of_the_library(path):
    assert not any(name.split(".")[0] in ("holotorch", "torch") for name in imports(path))


def test_top_level_holds_what_was_agreed():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {line.split("/")[0] for line in listed.stdout.splitlines()}
    agreed = {"pyproject.toml", "holotorch", "configs", "scripts", "tests", "README.md", "LICENSE"}
    assert {name for name in top if not name.startswith(".")} == agreed


def test_public_names():
    from holotorch import Grid, __version__
    from holotorch.correction import APG, PECProblem, ProjectedAdam, Solution, gerchberg_saxton
    from holotorch.hologram import AxialHologram, ConvolutionHologram, DirectHologram, plan_hologram
    from holotorch.metrics import psnr, ssim
    from holotorch.modulator import PhasedArray, ThermalCrosstalk
    from holotorch.optics import AngularSpectrum, Fraunhofer, Fresnel
    from holotorch.perception import EqualEfficiencyScale, PerceptionTime, cortical_scale
    from holotorch.scene import DVRSampler, SourceLayers, TransferFunction, Volume

    names = [Grid, APG, PECProblem, ProjectedAdam, Solution, gerchberg_saxton, psnr, ssim, PhasedArray]
    names += [AxialHologram, ConvolutionHologram, DirectHologram, plan_hologram]
    names += [DVRSampler, SourceLayers, TransferFunction, Volume]
    names += [ThermalCrosstalk, AngularSpectrum, Fraunhofer, Fresnel]
    names += [EqualEfficiencyScale, PerceptionTime, cortical_scale]
    assert all(name.__doc__ for name in names)
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    with pytest.raises(AttributeError, match="no attribute 'Gird'"):
        import holotorch

        holotorch.Gird  # noqa: B018


def test_the_names_that_most_scripts_begin_with_are_at_the_top():
    import holotorch
    from holotorch.optics import propagate
    from holotorch.tracking import CatheterTracker

    assert holotorch.propagate is propagate and holotorch.CatheterTracker is CatheterTracker
    assert all(getattr(holotorch, name) for name in holotorch.__all__)
    assert set(holotorch.__all__) <= set(dir(holotorch))


def test_every_dependency_has_its_licence_in_the_guide():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [each for needs in project["optional-dependencies"].values() for each in needs]
    names = {re.split(r"[<>=~!;\[ ]", each)[0] for each in [*project["dependencies"], *extras]}
    text = (ROOT / "scripts" / "docs" / "changes.md").read_text().partition("## Licences")[2]
    assert sorted(name for name in names if not re.search(rf"[ ]{re.escape(name)}[ ,:;]", text)) == []


GUIDE = sorted((ROOT / "scripts" / "docs").rglob("*.md"))


def blocks(language: str, page: Path = ROOT / "README.md") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)


def test_readme_example_runs_and_is_short():
    code = blocks("python")[0]
    steps = [line for line in code.splitlines() if line and not line.startswith(("import", "from"))]
    assert len(steps) <= 10
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, after = re.findall(r"tensor\(\[([^]]+)\]", done.stdout)
    losses = [[float(word) for word in text.split(",")] for text in (before, after)]
    assert all(small < 0.1 * large for small, large in zip(*losses, strict=True))


def test_further_readme_examples_run(tmp_path):
    """Drawing a propagated field, and a gradient from retina to heater."""
    draw, train = blocks("python", ROOT / "README.md")[1:]
    printed_by(draw, tmp_path)
    assert (tmp_path / "beam.png").stat().st_size > 10_000
    said = printed_by(train, tmp_path)
    assert float(said.split()[-1]) < 0.02, said
    assert len(train.splitlines()) <= 30


def test_readme_example_of_tracking_runs(tmp_path):
    code = blocks("python", ROOT / "scripts" / "docs" / "tracking.md")[0]
    said = printed_by(code, tmp_path)
    status, off = re.findall(r"^(\w+) ([\d.]+) mm off", said, re.M)[0]
    assert status == "OK" and float(off) < 0.5, said


@pytest.mark.parametrize("page", [ROOT / "README.md", *GUIDE], ids=lambda page: page.name)
def test_pages_name_files_that_exist_and_commands_that_parse(page):
    text = page.read_text()
    for path in re.findall(
        r"(?<![./\w])(?:configs|scripts|tests|holotorch)/[\w/.-]+\.(?:yaml|sh|png|py|txt|csv)", text
    ):
        assert ((PACKAGE.parent if path.startswith("holotorch/") else ROOT) / path).is_file(), path
    for link in re.findall(r"\]\(([^):]+)\)", text):
        assert (page.parent / link.partition("#")[0]).is_file(), link
    from holotorch.cli import _parser

    for line in "\n".join(blocks("bash", page)).splitlines():
        words = shlex.split(line.split("#")[0])
        if words[:1] == ["holotorch"]:
            _parser().parse_args(words[1:])


def test_the_readme_is_short_and_leads_to_every_page_of_the_guide():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 220
    guide = ROOT / "scripts" / "docs"
    assert all(f"(scripts/docs/{page.name})" in text for page in guide.glob("*.md"))
    first = (guide / "index.md").read_text()
    assert GUIDE and all(f"({page.relative_to(guide)})" in first for page in GUIDE if page.name != "index.md")
