"""Tables of a run."""

import numpy as np

from holotorch.experiments.runs.tables import write_table


def test_numbers_are_written_in_full_however_numpy_prints_them(tmp_path):
    """Importing a library may change that for the whole process (a find of scripts/kills.py)."""
    rows = [{"a": 1 / 3, "b": np.float64(2 / 3), "c": np.int64(7), "d": np.float32(0.5), "e": "text"}]
    with np.printoptions(legacy="1.13", precision=4):
        write_table(tmp_path / "table.csv", rows)
    assert (tmp_path / "table.csv").read_text() == f"a,b,c,d,e\n{1 / 3!r},{2 / 3!r},7,0.5,text\n"
