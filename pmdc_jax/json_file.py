"""Reading of JSON files that may have been edited by hand, with one message for what is invalid."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from .errors import InputError


def read_object(path: str | Path, form: str, mend: str) -> dict[str, Any]:
    """Read a JSON object from a file.

    **Arguments**: `form`, the value that its "format" must have if there is one; `mend`, for messages, how to get a
    valid file.

    **Raises**: `InputError` if the file is missing, cannot be read, is not a JSON object, or has another format.
    """
    where = str(path)
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(where, "there is no such file", mend) from None
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(where, what, "Check the path and its permissions") from None
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"is not JSON ({error})", mend) from None
    if not isinstance(content, dict):
        raise InputError(where, "is not a JSON object", mend)
    if "seconds" in content:  # every result has it, and no file that is read
        raise InputError(where, "looks like the result of --json", mend)
    given = content.get("format", form)
    if given != form:
        what = f'"format" is {given!r}, not {form!r}'
        if _kind(given) == _kind(form):
            mend = "Update pmdc_jax, or write the file again with this version"
        raise InputError(where, what, mend)
    return content


def _kind(form: object) -> str:
    """A format without its version."""
    return str(form).rpartition(" ")[0]


def finite_number(where: str, name: str, value: object, mend: str) -> float:
    """A number from a file as float; raises `InputError` for anything else, and for one beyond double precision."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            if math.isfinite(value):
                return float(value)
        except OverflowError:  # integers in JSON may have any length
            raise InputError(where, f"{name} is too large for double precision", mend) from None
    raise InputError(where, f"{name} is {value!r}, not a number", mend)
