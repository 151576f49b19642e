"""Logs of real robots: files of many formats as tables of columns, and what the columns mean."""

from forcegp.recordings.formats import open_source
from forcegp.recordings.importing import ImportOptions, import_recordings
from forcegp.recordings.mapping import ColumnMapping
from forcegp.recordings.mapping_file import mapping_text, read_mapping
from forcegp.recordings.source import Source

__all__ = [
    "ColumnMapping",
    "ImportOptions",
    "Source",
    "import_recordings",
    "mapping_text",
    "open_source",
    "read_mapping",
]
