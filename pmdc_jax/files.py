"""Result files: checked before a long computation, and written atomically."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import InputError

# what the file of an option may end in, if it ends in anything
SUFFIXES = {
    "--save": (".json",),
    "--json": (".json", ".txt"),
    "--report": (".html", ".htm"),
    "--experiment": (".csv",),
    "--c": (".h", ".c"),
}


def check_outputs(outputs: dict[str, Path | str | None], inputs: list[Path]) -> None:
    """Check before a computation that its results can be written; `outputs` maps each option to its path.

    **Raises**: `InputError` if one cannot, or if two outputs, or an output and an input, share a file.
    """
    taken = {path.resolve(): "an input" for path in inputs}
    for option, output in outputs.items():
        if output is None or (option == "--json" and str(output) == "-"):
            continue
        path = Path(output)
        if path.resolve() in taken:
            other = taken[path.resolve()]
            raise InputError(option, f"{path} is also {other}", "Give every output its own file")
        check_writable(option, path)
        if path.is_file() or not path.exists():  # devices such as /dev/null may be shared
            taken[path.resolve()] = f"the output of {option}"


def check_writable(option: str, path: Path) -> None:
    """**Raises**: `InputError` if a file cannot be written at `path`, the value of `option`."""
    if str(path) == "-":
        raise InputError(option, "only --json can write to standard output", "Give a file name")
    if path == Path():
        raise InputError(option, "the name is empty, or a folder", "Give a file name")
    if path.is_dir():
        raise InputError(option, f"{path} is a folder", "Give a file name")
    wanted = SUFFIXES.get(option, ())
    if wanted and path.suffix and path.suffix.lower() not in wanted:
        mend = f"Give a name that ends in {' or '.join(wanted)}"
        raise InputError(option, f"what it writes to {path} is no {path.suffix} file", mend)
    path = path.resolve()  # what a link points to is written
    folder = path.parent
    if not folder.is_dir():
        raise InputError(option, f"the folder {folder} does not exist", "Create it first, or choose another")
    replaces = path.is_file() or not path.exists()  # a device is written itself
    if (path.exists() and not os.access(path, os.W_OK)) or (replaces and not _takes_files(folder)):
        raise InputError(option, f"{path} cannot be written", "Choose another location")


def result_folder(path: Path, first: str) -> Path:
    """Make a folder for results, and check that a file named `first` can be written there, before the work begins.

    **Raises**: `InputError` if not.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError("--out", f"{path} is not a folder", "Give another folder") from None
    except OSError as error:
        what = f"the folder {path} cannot be made ({error.strerror})"
        raise InputError("--out", what, "Choose another location") from None
    check_writable("--out", path / first)
    return path


def _takes_files(folder: Path) -> bool:
    """Whether a file can be made in a folder; tried, because `os.access` grants the superuser every folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def write_text(path: str | Path, text: str) -> None:
    """Write a file atomically: readers see either the old or the new content.

    **Raises**: `InputError` if it cannot be written.
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path whose file replaces `path` at the end, and is deleted if writing fails.

    **Raises**: `InputError` if it cannot be written.
    """
    path = Path(path).resolve()  # resolves a link, which then stays a link
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    if path.exists() and not path.is_file():
        part = path  # a device such as /dev/stdout cannot be replaced
    try:
        yield part
        if part != path:
            part.replace(path)
    except OSError as error:
        what = f"it cannot be written ({error.strerror or error})"
        mend = "Choose an existing folder with free space and write permission"
        raise InputError(str(path), what, mend) from None
    finally:
        if part != path:
            part.unlink(missing_ok=True)
