from .kuka_surface import simulate_kuka_surface as simulate_kuka_surface
from .kuka_surface_config import KukaSurfaceConfig as KukaSurfaceConfig, SCENARIOS as SCENARIOS, Scenario as Scenario
