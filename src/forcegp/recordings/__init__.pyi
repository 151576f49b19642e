from .importing import (
    ImportOptions as ImportOptions, import_recordings as import_recordings, open_source as open_source,
)
from .mapping import ColumnMapping as ColumnMapping, EXAMPLES as EXAMPLES, by_quantity as by_quantity, listed as listed
from .mapping_file import beside as beside, read_mapping as read_mapping
from .source import Source as Source
