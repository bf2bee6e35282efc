"""Every figure of the README has a claim; claims and tables of guides are borne out by the files of the last runs."""

import importlib.util
import re

import pytest
from paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = sorted((ROOT / "scripts" / "docs").glob("*.md"))


def load_claims():
    spec = importlib.util.spec_from_file_location("claims", ROOT / "scripts" / "claims.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CLAIMS = load_claims()
VERDICTS = CLAIMS.verdicts()
CELLS = CLAIMS.cells()


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
