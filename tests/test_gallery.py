"""Every script of the gallery runs, in a tiny form, and draws its picture."""

import importlib.util
import re

import pytest
from paths import ROOT
from PIL import Image

SCRIPTS = sorted((ROOT / "scripts" / "gallery").glob("*.py"))


@pytest.mark.filterwarnings("ignore::holotorch.core.checks.SamplingWarning")
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_draws_its_picture(path, tmp_path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    out = tmp_path / "picture.png"
    module.main(out, 32)
    with Image.open(out) as picture:
        assert min(picture.size) > 100


def test_scripts_are_short_and_say_what_they_show():
    assert len(SCRIPTS) >= 12
    for path in SCRIPTS:
        text = path.read_text()
        assert len(text.splitlines()) <= 40, path.name
        assert re.match(r'"""[A-Z].*\."""\n', text), path.name
