"""MCAP files that were cut, as when a recorder is killed: a copy of what is whole, with an end."""

import io
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from forcegp.recordings.source import reading

MAGIC = b"\x89MCAP0\r\n"
CHUNK, DATA_END = 6, 15  # kinds of records; each begins with its kind and the length of its content
END = b"\x0f" + (4).to_bytes(8, "little") + bytes(4) + b"\x02" + (20).to_bytes(8, "little") + bytes(20) + MAGIC
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
READERS = {"zstd": (ZSTD, "ZstdDecompressor"), "lz4": ("lz4.frame", "LZ4FrameDecompressor")}


def is_cut(path: Path) -> bool:
    """Whether an MCAP file lacks its end."""
    with path.open("rb") as file:
        begin = file.read(len(MAGIC))
        file.seek(-min(len(MAGIC), path.stat().st_size), io.SEEK_END)
        return begin == MAGIC and file.read() != MAGIC


def whole_copy(path: Path, folder: Path) -> Path:
    """A copy of the records that are whole, those in the chunk at the cut among them. Raises FileFormatError."""
    copy = folder / path.name
    with reading(path, "a bag"), path.open("rb") as file, copy.open("wb") as made:
        made.write(file.read(len(MAGIC)))
        for kind, content, record in _records(file):
            size, name = int.from_bytes(content[16:24], "little"), int.from_bytes(content[28:32], "little")
            if kind == CHUNK and not record:
                packed = content[40 + name :]
                if name:
                    module, reader = READERS[content[32 : 32 + name].decode()]
                    packed = getattr(import_module(module), reader)().decompress(packed, max_length=size)
                record = b"".join(inside for _, _, inside in _records(io.BytesIO(packed)))
            made.write(b"" if kind >= DATA_END else record)
        made.write(END)
    return copy


def _records(file: Any) -> Iterator[tuple[int, bytes, bytes]]:
    """Kind, content, and the whole record, which is empty at the cut."""
    while len(head := file.read(9)) == 9:
        length = int.from_bytes(head[1:], "little")
        content = file.read(min(length, sys.maxsize))
        yield head[0], content, head + content if len(content) == length else b""
