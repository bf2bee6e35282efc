"""Tables of a run, as CSV."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from holotorch.io.files import write_text


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """CSV of rows that share their keys, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
