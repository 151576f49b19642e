from .importing import (
    ImportOptions as ImportOptions, beside as beside, import_recordings as import_recordings,
    open_source as open_source, read_mapping as read_mapping,
)
from .mapping import ColumnMapping as ColumnMapping, EXAMPLES as EXAMPLES, by_quantity as by_quantity, listed as listed
from .source import Source as Source
