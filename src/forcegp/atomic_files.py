"""Files and folders that appear whole or not at all: written in a hidden folder beside them, then renamed.

What fails leaves the old one; a killed process leaves `.NAME.*.tmp`, unlocked, which the next writer deletes.
"""

import contextlib
import ctypes
import hashlib
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from forcegp.errors import FileFormatError, InvalidInput

TEMPORARY = ".tmp"
LOCK, OLD = ".lock", ".old"
TRIAL = 2**16  # bytes that `require_writable` writes
MARK = "Written by forcegp"  # stands near the end of pages and robot files, which may be replaced
HOLE = 100 << 20  # bytes that a file may lack of its size
LARGEST_TEXT = 32 << 20
"""Bytes of JSON or of a list that forcegp wrote: digests, settings, results; most have some thousand."""


@contextmanager
def atomic_file(path: str | Path, *, overwrite: bool = True) -> Iterator[Path]:
    """A temporary path at which to write a file, which replaces `path` when the context ends without error.

    Raises InvalidInput if the folder of `path` does not exist, if `path` is no plain file, and if it is there by then.
    """
    target = _target(path)
    if not target.parent.is_dir():
        raise InvalidInput(f"cannot write {path}: the folder {target.parent} does not exist; create it first.")
    if target.is_dir():
        raise InvalidInput(f"cannot write {path}: it is a folder; give a file name.")
    if target.exists() and not target.is_file():
        raise InvalidInput(f"cannot write {path}: it is not a regular file; choose another name.")
    with _beside(target) as temporary:
        yield temporary
        _flush(temporary)
        if not overwrite:
            try:
                os.link(temporary, target)  # unlike a rename, never over what another process has written meanwhile
                return
            except FileExistsError:
                raise InvalidInput(f"{path} exists already; choose another name, or add `overwrite=True`.") from None
            except OSError:  # a file system without hard links
                pass
        os.replace(temporary, target)


@contextmanager
def atomic_folder(path: str | Path, *, overwrite: bool = True) -> Iterator[Path]:
    """A temporary path at which to make a folder, which becomes `path` when the context ends without error.

    A folder that is there stays in place until the new one is complete. Without `overwrite` it stays for good and an
    OSError is raised, unless it is empty. Raises InvalidInput if `path` is no folder.
    """
    target = _target(path)
    if target.exists() and not target.is_dir():
        raise InvalidInput(f"cannot write the folder {path}: it is a file; choose another name.")
    target.parent.mkdir(parents=True, exist_ok=True)
    with _beside(target) as temporary:
        yield temporary
        for entry in (*temporary.rglob("*"), temporary):
            _flush(entry)
        if target.exists() and (overwrite or not any(target.iterdir())):
            _exchange(temporary, target)
        else:
            temporary.rename(target)  # fails where another process has made the folder meanwhile


@contextmanager
def locked(path: Path, taken: str) -> Iterator[None]:
    """No other process holds this file meanwhile. Raises InvalidInput with the words of `taken` if one does."""
    from filelock import FileLock, Timeout  # which --help does without

    try:
        with FileLock(path).acquire(blocking=False):
            yield
    except Timeout:
        raise InvalidInput(taken) from None


def require_writable(path: str | Path) -> None:
    """Write a little where `path` will be, and delete it: disks that are full are noticed first. Raises OSError."""
    target = _target(path)
    with _beside(next(folder for folder in target.parents if folder.exists()) / target.name) as temporary:
        temporary.write_bytes(bytes(TRIAL))
        _flush(temporary)


def require_replaceable(
    folder: Path, writer: str, ours: Callable[[Path], object], *, overwrite: bool, own: Iterable[str] = ()
) -> None:
    """Refuse what exists, but empty folders, and with `overwrite` what is `ours` alone. Raises FileFormatError."""
    known: object = False
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    with contextlib.suppress(FileFormatError):
        known = folder.is_dir() and ours(folder)
    if not known:
        what = f"exists and was not written by {writer}, so it is not overwritten; choose another name."
        raise FileFormatError(f"{folder} {what}")
    if not overwrite:
        raise FileFormatError(f"{folder} exists already; choose another name, or add `overwrite=True`.")
    listed = {SUMS, *own}
    if why := unreadable(folder / SUMS):
        raise FileFormatError(f"{folder / SUMS} {why}; choose another name.")
    with contextlib.suppress(OSError, ValueError):
        listed |= {line[66:] for line in (folder / SUMS).read_text(encoding="utf-8").splitlines()}
    entries = (entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir())
    if others := sorted({entry.relative_to(folder).as_posix() for entry in entries} - listed):
        seen = f"{folder} holds files that {writer} did not write ({', '.join(others[:3])}), so it is not overwritten"
        raise FileFormatError(f"{seen}; move them away, or choose another name.")


def write_text(path: str | Path, text: str, *, overwrite: bool = True) -> None:
    """Write UTF-8 text with the line ends that it has. Raises as `atomic_file`."""
    with atomic_file(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(text.encode("utf-8"))


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write readable JSON. Raises as `atomic_file`, and ValueError for NaN and infinity, which JSON does not have."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def unreadable(path: Path, most: float = LARGEST_TEXT) -> str | None:
    """What speaks against opening a file: pipes and devices never end, and one of more bytes than `most` is another."""
    if path.is_dir() or not path.exists():  # for which opening has its own errors
        return None
    if not path.is_file():
        return "is not a regular file"
    size = path.stat().st_size
    return None if size <= most else f"holds {size >> 20} MiB, more than the {most / 2**20:.0f} MiB of such a file"


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Return the JSON object in a file. Raises FileFormatError, which ends in the remedy, for anything else."""
    if why := unreadable(path):
        raise FileFormatError(f"{path} {why}; {remedy}.")
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # also numbers of 5000 digits
        raise FileFormatError(f"{path} is half written or damaged ({error}); {remedy}.") from None
    if not isinstance(stored, dict):
        raise FileFormatError(f"{path} is damaged; {remedy}.")
    return stored


def is_marked(path: Path) -> bool:
    """Whether a file ends as those that forcegp marks with `MARK`; no more of it is read, for it may be another."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 200, 0))
        return MARK.encode() in file.read()


def remove_leftovers(folder: Path) -> None:
    """Delete what killed processes left half written in a folder and those inside it."""
    for entry in list(folder.rglob(f".*{TEMPORARY}")):
        _remove_if_left(entry)


def _target(path: str | Path) -> Path:
    """Where a rename has to end: a rename onto a symbolic link would replace the link, not what it points to."""
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise InvalidInput(f"cannot write {path}: it is a link that leads back to itself; choose another name.")
    return target


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """A path of the same name in a hidden folder beside the target, which is there for as long as the context."""
    from filelock import FileLock, Timeout  # 40 ms that only writing costs

    name = target.name[:40]  # so that the longest names that file systems allow do not become too long
    left = re.compile(rf"\.{re.escape(name)}\.[0-9a-f]{{12}}\{TEMPORARY}")
    with contextlib.suppress(OSError):  # a folder that may be written, but not listed
        for entry in list(target.parent.iterdir()):
            if left.fullmatch(entry.name):
                _remove_if_left(entry)
    while True:
        hidden = target.with_name(f".{name}.{secrets.token_hex(6)}{TEMPORARY}")
        hidden.mkdir()
        lock = FileLock(hidden / LOCK)
        try:
            lock.acquire(blocking=False)
        except Timeout:  # taken for a left-over by another process, before it was locked
            continue
        except BaseException:
            shutil.rmtree(hidden, ignore_errors=True)
            raise
        break
    try:
        yield hidden / target.name
    finally:
        lock.release()
        if target.exists() or not (hidden / OLD).exists():  # else the old folder is the only copy
            shutil.rmtree(hidden, ignore_errors=True)


def _remove_if_left(entry: Path) -> None:  # unless the process that made it lives
    from filelock import FileLock, Timeout

    lock = FileLock(entry / LOCK)
    with contextlib.suppress(OSError, Timeout):  # being written, or not ours to delete
        lock.acquire(blocking=False)
        for old in (entry / OLD).glob("*"):  # killed between two renames
            if not (entry.parent / old.name).exists():
                old.rename(entry.parent / old.name)
        shutil.rmtree(entry, ignore_errors=True)
    lock.release()


def _flush(path: Path) -> None:
    """Wait until the contents are on the disk: a rename may be there first, and a power cut would leave nothing."""
    folder = path.is_dir()
    if folder and os.name == "nt":  # Windows opens no folders, and orders these writes itself
        return
    descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)  # Windows flushes only what may be written to
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _exchange(new: Path, target: Path) -> None:
    """Put the new folder in the place of the old one, which lies in the hidden folder then and is deleted with it."""
    if _swapped(new, target):
        return
    aside = new.parent / OLD / target.name
    aside.parent.mkdir()
    target.rename(aside)
    try:
        new.rename(target)
    except BaseException:
        aside.rename(target)
        raise


def _swapped(one: Path, other: Path) -> bool:
    """Exchange two folders in one step, so that a kill leaves no moment without either, where the system can."""
    if os.name == "nt":
        return False
    libc, names = ctypes.CDLL(None), (os.fsencode(one), os.fsencode(other))
    if hasattr(libc, "renameat2"):  # Linux: relative to the current folder, RENAME_EXCHANGE
        return libc.renameat2(-100, names[0], -100, names[1], 2) == 0
    return hasattr(libc, "renamex_np") and libc.renamex_np(*names, 2) == 0  # macOS: RENAME_SWAP


SUMS = "SHA256SUMS"


def write_digests(folder: Path) -> None:
    """Write the digests of all files that are in the folder and those below it."""
    names = (file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    (folder / SUMS).write_bytes(b"".join(_lines(folder, (name for name in names if name != SUMS))))


def require_unchanged(folder: Path, remedy: str) -> None:
    """Raises FileFormatError, with the remedy, where a file is not as written; those that were added do not matter."""
    sums = folder / SUMS
    if not sums.exists():
        raise FileFormatError(f"{folder} is incomplete: it has no {SUMS}; {remedy}")
    if why := unreadable(sums):
        raise FileFormatError(f"{folder} is damaged: {SUMS} {why}; {remedy}")
    try:
        stored = sums.read_bytes().splitlines(True)
        names = [line[66:].decode("utf-8").removesuffix("\n") for line in stored]
        for name in names:
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or not (folder / name).is_file():
                raise FileFormatError(f"{folder} lacks {name!r}, which {SUMS} lists; {remedy}")
        now = _lines(folder, names)
        if not now or stored != now:
            changed = ", ".join(line[66:-1].decode() for line in now if line not in stored)
            raise FileFormatError(f"{folder} is damaged: {changed or SUMS} is not as it was written; {remedy}")
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{folder} is damaged: {SUMS} cannot be read ({error}); {remedy}") from None


def _lines(folder: Path, names: Iterable[str]) -> list[bytes]:
    return [f"{file_digest(folder / name)}  {name}\n".encode() for name in sorted(names)]


def file_digest(path: Path) -> str:
    """The SHA-256 of a file. Raises FileFormatError for one that is almost all hole, which would be read for hours."""
    if (size := path.stat().st_size) > max(HOLE, 200 * 512 * getattr(path.stat(), "st_blocks", math.inf)):
        raise FileFormatError(f"{path} claims {size >> 20} MiB that are not there; copy or write it again.")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
