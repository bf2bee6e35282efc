"""Figures of README and guides have a claim; claims and tables are borne out by the files of the last runs."""

import importlib.util
import re

import pytest
from paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = [path for path in sorted((ROOT / "scripts" / "docs").rglob("*.md")) if path.parent.name != "dissertation"]


def load_claims():
    spec = importlib.util.spec_from_file_location("claims", ROOT / "scripts" / "claims.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CLAIMS = load_claims()
VERDICTS = CLAIMS.verdicts()
CELLS = CLAIMS.cells()
QUOTES = CLAIMS.quotes()


def rows() -> list[str]:
    table = README.split("## Some figures, and what prints them")[1].split("\n\n")[1]
    return table.splitlines()[2:]


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[2:40])
def test_a_row_of_the_readme_has_a_claim_with_its_command(row):
    claims = [verdict for verdict in VERDICTS if verdict.says in row]
    assert claims, "add the row to scripts/charts/claims/claims.yaml"
    assert all(f"`{verdict.command}`" in row for verdict in claims)


@pytest.mark.parametrize("verdict", VERDICTS, ids=lambda verdict: verdict.says[:40])
def test_a_claim_is_borne_out(verdict):
    assert verdict.says in README, "the README no longer says so"
    assert verdict.holds, verdict


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.stem)
def test_lines_of_verdict_in_a_guide_are_those_of_the_last_run(path):
    """Indented lines of a guide that quote a verdict: all their clauses are in one line of it, word for word."""
    files = (ROOT / "scripts" / "charts").glob("*/verdict.txt")
    known = [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    for block in re.findall(r"verdict:\*\n\n((?:    .*\n)+)", path.read_text(encoding="utf-8")):
        for line in block.splitlines():
            clauses = re.split("[,;] ", line.strip())
            assert any(all(each in other for each in clauses) for other in known), f"in no verdict.txt: {line}"


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: f"{cell.guide}: {cell.row[2:34]}")
def test_a_number_in_a_table_of_a_guide_is_that_of_the_last_run(cell):
    assert cell.holds, cell


@pytest.mark.parametrize("quote", QUOTES, ids=lambda quote: f"{quote.guide}: {quote.says[:40]}")
def test_a_result_in_the_prose_of_a_guide_is_borne_out(quote):
    assert quote.holds, quote
    assert not quote.untested, "numbers without a test; those that are settings go into the row's list 'given'"


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.stem)
def test_a_number_in_the_prose_of_a_guide_has_a_row(path):
    """A number that looks measured is in a quote of prose.yaml: of a result, of what is not measured, or of a test."""
    name = str(path.relative_to(CLAIMS.GUIDES).with_suffix(""))
    assert not CLAIMS.uncovered(name), "add a row to scripts/charts/claims/prose.yaml"


# The tables of the other two pages show sections of the dissertation, and licences.
TABLES = [path for path in GUIDES if path.stem not in ("dissertation", "changes")]


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_a_number_in_a_table_of_a_guide_has_a_row(path):
    """A row of a table with numbers that look measured is in tables.yaml, as measured or as not."""
    name = str(path.relative_to(CLAIMS.GUIDES).with_suffix(""))
    assert not CLAIMS.bare_rows(name), "add the row to scripts/charts/claims/tables.yaml"


def test_a_row_of_a_table_without_its_file_is_caught(tmp_path):
    (tmp_path / "guide.md").write_text("| a | SSIM |\n|---|---|\n| b | 0.51 |\n| c | 14 dB |\n| d | 7 |\n")
    (tmp_path / "tables.yaml").write_text("- {guide: guide, not_measured: ['| c |']}")
    assert CLAIMS.bare_rows("guide", tmp_path, tmp_path) == ["| b | 0.51 |"]
    (tmp_path / "tables.yaml").write_text("- {guide: guide, not_measured: ['| e |']}")
    with pytest.raises(ValueError, match="no longer there"):
        CLAIMS.bare_rows("guide", tmp_path, tmp_path)


def test_files_of_the_lists_of_tests_are_there():
    missing = [file for row in CLAIMS.load(CLAIMS.FOLDER / "prose.yaml") for file in row.get("in_tests", {}).values()]
    assert missing and all((ROOT / file).is_file() for file in missing)


@pytest.fixture
def prose(tmp_path):
    """A function that judges a guide by rows for it: verdicts, untested numbers, and numbers without a row."""

    def judge(guide: str, rows: str):
        (tmp_path / "guide.md").write_text(guide)
        (tmp_path / "run.csv").write_text("m,x\na,0.514\nb,0.257\n")
        (tmp_path / "prose.yaml").write_text(rows)
        found = CLAIMS.quotes(tmp_path, tmp_path)
        bare = CLAIMS.uncovered("guide", tmp_path, tmp_path)
        return [quote.holds for quote in found], [each for quote in found for each in quote.untested], len(bare)

    return judge


ROW = """
- guide: guide
  says: "SSIM is {shown} at sigma 0.66"
  command: x
  file: run.csv
  given: ["0.66"]
  tests: [{{shows: "{shown}", column: x, rows: {{m: a}}}}]
"""


def test_a_number_in_prose_that_its_file_contradicts_is_caught(prose):
    assert prose("The SSIM\nis 0.51 at sigma 0.66.\n", ROW.format(shown="0.51")) == ([True], [], 0)
    assert prose("The SSIM\nis 0.52 at sigma 0.66.\n", ROW.format(shown="0.52")) == ([False], [], 0)
    assert prose("The SSIM is 0.514 at sigma 0.66.", ROW.format(shown="0.514").replace("given", "other"))[1] == ["0.66"]
    with pytest.raises(ValueError, match="0 times 'SSIM is 0.51 at sigma 0.66'"):
        prose("The SSIM is 0.52 at sigma 0.66.", ROW.format(shown="0.51"))
    tests = """
    - {shows: "2", find: "a,([0-9.]+)", over: "b,([0-9.]+)"}
    - {shows: "50", column: x, rows: {m: a}, minus: {column: x, rows: {m: b}}, over: "a,([0-9.]+)", scale: 100}
    - {shows: "39", column: x, rows: {}, take: mean, scale: 100}
    - {at_most: 6, column: x, rows: {}, take: max}
"""
    row = f"- guide: guide\n  says: 2 times, 50 %, 39 ms, 6\n  command: x\n  file: run.csv\n  tests:{tests}"
    assert prose("It takes 2 times, 50 %, 39 ms, 6.", row) == ([True], [], 0)


LOOK_MEASURED = (
    "error of 0.3",
    "below 1e-3",
    "18 % off",
    "14 dB more",
    "20 times as fast",
    "3 of 48 fail",
    "4 to 5 ms",
)


@pytest.mark.parametrize("text", LOOK_MEASURED)
def test_a_number_in_prose_without_a_row_is_caught(text, prose):
    none, row = "- {guide: guide}", f"- {{guide: guide, not_measured: ['{text}']}}"
    assert prose(f"So: {text}.", none)[2] > 0
    assert prose(f"So: {text}.", row)[2] == 0
    assert prose(f"| {text} |\n\n    {text}\n\n```\n{text}\n```\n`{text}`, Sec. 3.4, Figs. 2.3 and 2.4.", none)[2] == 0
    with pytest.raises(ValueError, match="no longer there"):
        prose("So.", row)


def test_a_number_in_a_table_that_its_file_contradicts_is_caught(tmp_path):
    (tmp_path / "guide.md").write_text("| a | 0.51 +- 0.2 | 3 |\n| b | 0.5 | 4 |\n")
    (tmp_path / "run.csv").write_text("m,x,y\na,0.514,0.2\nb,0.56,1\nb,0.46,4\n")
    (tmp_path / "tables.yaml").write_text(
        """
- guide: guide
  row: "| a"
  cells: [{file: run.csv, rows: {m: a}, columns: [x, y]}, {file: run.csv, rows: {m: a}, columns: [y]}]
- {guide: guide, row: "| b", cells: [{file: run.csv, worst: true, rows: {m: b}, columns: [x]}]}
"""
    )
    assert [cell.holds for cell in CLAIMS.cells(tmp_path, tmp_path)] == [True, False, True]
    (tmp_path / "guide.md").write_text("| a | 0.51 +- 0.2 | 3 |\n")
    with pytest.raises(ValueError, match="0 rows begin with '| b'"):
        CLAIMS.cells(tmp_path, tmp_path)


def test_a_claim_that_its_file_contradicts_is_caught(tmp_path):
    (tmp_path / "run.json").write_text('{"a": {"b": 0.5}}')
    (tmp_path / "run.txt").write_text("speed 40\ntime 8 s\n")
    (tmp_path / "claims.yaml").write_text(
        """
- {says: right, command: x, file: run.json, tests: [{json: a.b, is: 0.51, margin: 0.02}]}
- {says: wrong, command: x, file: run.json, tests: [{json: a.b, is: 0.55, margin: 0.02}]}
- {says: ratio, command: x, file: run.txt, tests: [{find: "speed (\\\\d+)", over: "^time (\\\\d+)", is: 5, margin: 0}]}
- {says: limit, command: x, file: run.txt, tests: [{find: "time (\\\\d+)", at_most: 7}]}
- {says: least, command: x, file: run.txt, tests: [{find: "time (\\\\d+)", at_least: 7}]}
"""
    )
    assert [verdict.holds for verdict in CLAIMS.verdicts(tmp_path)] == [True, False, True, False, True]
    (tmp_path / "claims.yaml").write_text(
        '- {says: none, command: x, file: run.txt, tests: [{find: "(depth)", at_most: 7}]}'
    )
    with pytest.raises(ValueError, match="nothing like '\\(depth\\)'"):
        CLAIMS.verdicts(tmp_path)
