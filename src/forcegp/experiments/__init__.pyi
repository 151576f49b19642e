from .pages import page_of as page_of
from .presets import experiments_of as experiments_of
from .reproduction import page_name as page_name, reproduce as reproduce
