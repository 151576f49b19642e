from .reproduction import (
    PAPER_PAGE as PAPER_PAGE, reproduce as reproduce, experiments_of as experiments_of,
)
