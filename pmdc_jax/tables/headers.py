"""Headers of columns, whatever the kind of file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError


def with_unit(name: str, unit: str) -> str:
    """A header with the unit below it, unless it says that by itself, as speed_rad_s does of rad/s."""
    said, new = (re.sub(r"\W+|_+", "_", text).strip("_") for text in (name, unit))
    return name if not new or said.endswith(f"_{new}") else f"{name} [{unit}]"


def refuse_duplicates(headers: Sequence[str], path: Path) -> None:
    """**Raises**: `InputError` where two columns have the same name; they may have none."""
    for header, count in Counter(headers).items():
        if count > 1 and header:
            what = f"the header names '{header}' {count} times"
            raise InputError(f"{path}, column {header}", what, "Give every column its own name")
