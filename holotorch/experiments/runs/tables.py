"""Tables of a run, as CSV files."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from holotorch.io.files import write_text


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows with the same keys as CSV; the file is replaced only when all of it is written."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    # A number of NumPy is written as NumPy prints it, which other libraries change; a float, always in full.
    writer.writerows(
        {key: value.item() if isinstance(value, np.generic) else value for key, value in row.items()} for row in rows
    )
    write_text(path, text.getvalue())
