"""Results as JSON: finite numbers in SI, and null for unknown values."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from attrs import asdict, has

from ..files import write_text


def write_json(content: dict[str, Any], path: str | Path) -> None:
    """Write `plain` content to a file atomically, or to standard output if the path is "-"."""
    to_stdout = str(path) == "-"  # its encoding is unknown, hence plain ASCII
    text = json.dumps(content, indent=2, ensure_ascii=to_stdout, allow_nan=False) + "\n"
    if to_stdout:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_text(path, text)


def plain(value: Any) -> Any:
    """Records as dictionaries of their fields, tuples and arrays as lists, NumPy and JAX scalars as Python scalars, NaN
    and infinity as None.

    A confidence interval with an unknown end becomes None as a whole.
    """
    if has(type(value)):
        value = asdict(value, recurse=False)
    if isinstance(value, Mapping):
        return {
            str(key): None if key == "ci95" and _has_unknown_end(item) else plain(item) for key, item in value.items()
        }
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if isfinite(value) else None
    return str(value)


def _has_unknown_end(interval: Any) -> bool:
    return interval is not None and not all(isfinite(float(end)) for end in interval)
