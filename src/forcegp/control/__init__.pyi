from .mppi import MPPI as MPPI
