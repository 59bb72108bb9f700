"""Column headers of any kind of file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ...errors import InputError


def with_unit(name: str, unit: str) -> str:
    """A column name with its unit in brackets; unchanged if it ends with that unit, as speed_rad_s does with rad/s."""
    name_words, unit_words = (re.sub(r"\W+|_+", "_", text).strip("_") for text in (name, unit))
    return name if not unit_words or name_words.endswith(f"_{unit_words}") else f"{name} [{unit}]"


def refuse_duplicates(headers: Sequence[str], path: Path) -> None:
    """**Raises**: `InputError` if two columns have the same name; empty names may repeat."""
    for header, count in Counter(headers).items():
        if count > 1 and header:
            what = f"the header names '{header}' {count} times"
            raise InputError(f"{path}, column {header}", what, "Give every column its own name")
