"""`SHA256SUMS`: a digest of every file of a stored folder, because a bit that flipped on a disk changes predictions.

The format is that of `sha256sum`. The file protects itself: its text must be exactly the one that the files give.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from forcegp.errors import FileFormatError

SUMS = "SHA256SUMS"


def write_digests(folder: Path) -> None:
    """Write the digests of all files that are in the folder and those below it."""
    names = (file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    (folder / SUMS).write_bytes(_text(folder, (name for name in names if name != SUMS)).encode("utf-8"))


def require_unchanged(folder: Path, remedy: str) -> bool:
    """Whether the folder has digests; raises FileFormatError, which ends in the remedy, where a file is not as written.

    Files that were added are no concern of this.
    """
    sums = folder / SUMS
    if not sums.exists():
        return False
    if sums.is_fifo():  # to open it would wait for a writer for ever
        raise FileFormatError(f"{folder} is damaged: {SUMS} is not a regular file; {remedy}")
    try:
        stored = sums.read_bytes().decode("utf-8")
        names = [line[66:] for line in stored.splitlines()]
        for name in names:
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or not (folder / name).is_file():
                raise FileFormatError(f"{folder} lacks {name!r}, which {SUMS} lists; {remedy}")
        if not names or stored != _text(folder, names):
            changed = ", ".join(name for name in names if _line(folder, name) not in stored.splitlines(True))
            raise FileFormatError(f"{folder} is damaged: {changed or SUMS} is not as it was written; {remedy}")
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{folder} is damaged: {SUMS} cannot be read ({error}); {remedy}") from None
    return True


def added_files(folder: Path, own: Iterable[str] = ()) -> list[str]:
    """Files in the folder that nobody lists: neither its digests, nor `files` of its config.json, nor `own`."""
    known = {SUMS, *own}
    with contextlib.suppress(OSError, ValueError):
        known |= {line[66:] for line in (folder / SUMS).read_text(encoding="utf-8").splitlines()}
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):  # folders of before had no digests
        known |= set(json.loads((folder / "config.json").read_text(encoding="utf-8")).get("files", ()))
    entries = (entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir())
    return sorted({entry.relative_to(folder).as_posix() for entry in entries} - known)


def _text(folder: Path, names: Iterable[str]) -> str:
    return "".join(_line(folder, name) for name in sorted(names))


def _line(folder: Path, name: str) -> str:
    with (folder / name).open("rb") as file:
        return f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {name}\n"
