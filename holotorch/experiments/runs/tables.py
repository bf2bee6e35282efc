"""Tables of a run, as CSV files."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from holotorch.io.files import write_text


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows with the same keys as CSV; the file is replaced only when all of it is written."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
