"""URDF files: bytes on disk <-> text, in the encoding that the XML declares."""

from __future__ import annotations

from pathlib import Path

from forcegp.atomic_files import write_bytes
from forcegp.errors import UnreadableRobotFile


def read_text(path: str | Path) -> str:
    """Decode a URDF file; :class:`UnreadableRobotFile` where there is none or it is not text."""
    path = Path(path)
    if path.is_fifo():  # to open it would wait for a writer for ever
        raise UnreadableRobotFile(f"{path}: is not a regular file; give the path of a URDF file.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UnreadableRobotFile(f"{path}: no such file; give the path of a URDF file.") from None
    except IsADirectoryError:
        inside = sorted(entry.name for entry in path.iterdir() if entry.suffix == ".urdf")
        hint = f" It holds {', '.join(inside)}." if inside else ""
        raise UnreadableRobotFile(f"{path}: is a directory; give the path of the URDF file itself.{hint}") from None
    except OSError as error:
        raise UnreadableRobotFile(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions."
        ) from None
    encoding = declared_encoding(data)
    try:
        return data.decode(encoding)
    except (ValueError, LookupError):  # codecs raise more than UnicodeDecodeError
        raise UnreadableRobotFile(
            f"{path}: is not {encoding} text; save the URDF as UTF-8, or declare its encoding in the first line "
            '(<?xml version="1.0" encoding="..."?>).'
        ) from None


def declared_encoding(data: bytes) -> str:
    """Encoding of an XML file from its byte-order mark or XML declaration; UTF-8 by default."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    head = data.removeprefix(b"\xef\xbb\xbf")[:200].split(b"?>")[0].decode("ascii", errors="replace")
    if head.startswith("<?xml") and "encoding" in head:
        value = head.split("encoding", 1)[1].lstrip(" \t\r\n=")
        return value[1:].split(value[:1], 1)[0] if value[:1] in "'\"" else "utf-8"
    return "utf-8"


def write_text(text: str, path: Path) -> None:
    """Write URDF text in the encoding that it declares. Raises as `atomic_file`."""
    write_bytes(path, text.encode(declared_encoding(text[:200].encode("utf-8"))))
