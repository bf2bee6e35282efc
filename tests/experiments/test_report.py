import base64
import re
import shutil
from html.parser import HTMLParser

import pytest
from paths import CONFIGS
from tiny_runs import command

from holotorch.cli import main
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.execute import execute
from holotorch.experiments.registry import KINDS, load_config
from holotorch.experiments.report import write_report

VOID = {"meta", "img", "br"}


class Balanced(HTMLParser):
    """Fails on tags that are not closed in order."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    base = tmp_path_factory.mktemp("runs")
    words = ["grid.shape=[16,16]", "solver.max_steps=3"]
    for name, config in (("first <b>", "fourier"), ("second", "fresnel")):
        execute(load_config(CONFIGS / "pec" / f"{config}.yaml", words), base / name)
    return [base / "first <b>", base / "second"]


def test_one_static_page_with_pictures_inside(folders):
    page = (folders[0] / "report.html").read_text()
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert "<script" not in page and "http" not in page
    assert "width=device-width" in page and "prefers-color-scheme: dark" in page  # telephones, dark mode
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == page.count("<img") == 8
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)
    for words in ("Target", "No correction", "Corrected", "Convergence", "degC above ambient", "sigma_px: 0.66"):
        assert words in page
    assert "first &lt;b&gt;" in page and "first <b>" not in page


def test_columns_that_say_nothing_are_left_out(folders):
    assert "chip alone" not in (folders[0] / "report.html").read_text()
    assert "chip alone" in (folders[1] / "report.html").read_text()


def test_several_runs_are_compared(folders, tmp_path):
    write_report(folders, tmp_path / "both.html")
    page = (tmp_path / "both.html").read_text()
    assert page.count("<img") == 16
    assert re.search(r"<h1>Runs</h1>.*first &lt;b&gt;.*second", page, re.S)


def test_refuses_a_folder_without_a_run(folders, tmp_path):
    with pytest.raises(ConfigError, match="holds no run: neither summary.json nor interrupted.json"):
        write_report([tmp_path], tmp_path / "report.html")
    shutil.copytree(folders[0], tmp_path / "a")
    for text in ("{", "[]", '{"methods": {}}', '{"methods": {"corrected": {}}}', '{"methods": {"other": {}}}'):
        (tmp_path / "a" / "summary.json").write_text(text)
        with pytest.raises(ConfigError, match="cannot be read"):
            write_report([tmp_path / "a"], tmp_path / "report.html")


def test_runs_of_all_kinds_share_a_page(folders, tmp_path, capsys, tiny):
    names = ("study", "layout", "analysis")
    for name in names:
        assert main(command(name, tmp_path / name)) == 0
    own = (tmp_path / "layout" / "report.html").read_text()
    for words in (
        "<h2>Sizes</h2>",
        "<h2>How to repeat</h2>",
        "Icons framed in grey",
        "Displays, those of thesis Table 2.1",
    ):
        assert words in own
    every = [*map(str, folders), *(str(tmp_path / name) for name in names)]
    assert main(["report", *every, "--out", str(tmp_path / "all.html")]) == 0
    page = (tmp_path / "all.html").read_text()
    assert all(words in page for words in ("<h1>Runs</h1>", "study: limits", "<h1>layout</h1>", "<h1>analysis</h1>"))
    assert page.count("<style>") == page.count("<!DOCTYPE html>") == 1


def test_runs_of_no_kind_are_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "summary.json").write_text('{"experiment": "dream", "status": "complete"}')
    for page in ("", f"; its own page is {tmp_path}/report.html"):
        assert main(["report", str(tmp_path)]) == 2
        words = f"{tmp_path} holds a run of kind dream, and only those of {', '.join(KINDS)} can be shown together"
        assert capsys.readouterr().err == f"{words}{page}\n"
        (tmp_path / "report.html").write_text("its own")
    assert (tmp_path / "report.html").read_text() == "its own"
