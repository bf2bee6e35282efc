"""The guide, the gallery and the pages of public names as HTML: built without a network, and no link leads nowhere."""

import importlib
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from apart import printed_by
from paths import ROOT

BUILD = ROOT / "scripts" / "docs" / "build.py"


class Links(HTMLParser):
    """Where a page leads, what it loads, and the places in it that others may lead to."""

    def __init__(self, text: str):
        super().__init__()
        self.links, self.loads, self.places = list[str](), list[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value for name, value in attrs if value}
        self.places.update(values.get(name, "") for name in ("id", "name"))
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in ("img", "script", "link") and (source := values.get("src") or values.get("href")):
            self.loads.append(source)


def printed(page: str, folder: Path) -> str:
    """What the Python of a page about a task prints, run in ``folder``."""
    text = (BUILD.parent / "tasks" / page).read_text(encoding="utf-8")
    return printed_by("\n".join(re.findall(r"```python\n(.*?)```", text, re.S)), folder, strict=True)


def test_the_numbers_of_a_design_are_those_on_its_page(tmp_path):
    text = printed("design_a_display.md", tmp_path)
    assert [each for each in ("7.97 deg", "10.94 deg", "at 0.36 m", "93.3 mm", "10 nm") if each not in text] == []


def test_the_network_of_its_page_learns(tmp_path):
    losses = [float(line.split()[1]) for line in printed("train_with_it.md", tmp_path).splitlines()]
    assert losses[-1] < 0.6 * losses[0]


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[Path, Links]:
    pytest.importorskip("sphinx_gallery", reason="the guide needs pip install 'holotorch[docs]'")
    out = tmp_path_factory.mktemp("guide")
    done = subprocess.run([sys.executable, BUILD, "--quick", "--out", out], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return {path: Links(path.read_text(encoding="utf-8")) for path in sorted((out / "html").rglob("*.html"))}


def test_every_link_of_the_built_guide_leads_somewhere(pages):
    wrong = []
    for page, content in pages.items():
        for link in (*content.links, *content.loads):
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            there = pages[target].places if parts.fragment and target in pages else {parts.fragment}
            if not target.is_file() or unquote(parts.fragment) not in there | {""}:
                wrong.append(f"{page.name}: {link}")
    assert not wrong


def test_the_built_guide_needs_no_network(pages):
    assert pages
    assert [link for content in pages.values() for link in content.loads if urlsplit(link).netloc] == []


def test_every_script_of_the_gallery_has_a_page_with_its_picture(pages):
    scripts = sorted(path.stem for path in (ROOT / "scripts" / "gallery").glob("*.py"))
    shown = {page.stem: content for page, content in pages.items() if page.parent.name == "gallery"}
    assert set(scripts) <= shown.keys()
    assert all(any(re.search(rf"sphx_glr_{name}_001", source) for source in shown[name].loads) for name in scripts)


def test_every_public_name_has_a_place(pages):
    places = {place for content in pages.values() for place in content.places}
    for package in ("optics", "modulator", "correction", "scene", "hologram", "tracking", "perception", "metrics"):
        names = importlib.import_module(f"holotorch.{package}").__all__
        assert [name for name in names if f"holotorch.{package}.{name}" not in places] == []
