from .tables import DELIMITERS as DELIMITERS
from .importing import (
    ImportOptions as ImportOptions, import_recordings as import_recordings, open_source as open_source,
)
from .mapping import (
    ColumnMapping as ColumnMapping, beside as beside, by_quantity as by_quantity,
    mapping_of as mapping_of, mapping_text as mapping_text, read_mapping as read_mapping,
)
from .source import Source as Source
