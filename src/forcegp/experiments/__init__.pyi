from .reproduction import (
    page_of as page_of, page_name as page_name, reproduce as reproduce, experiments_of as experiments_of,
)
