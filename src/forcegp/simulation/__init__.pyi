from .moving_bases import simulate_quadrotor as simulate_quadrotor, simulate_quadruped as simulate_quadruped
from .kuka_surface import kuka_file as kuka_file, simulate_kuka_surface as simulate_kuka_surface
from .scenarios import (
    KukaSurfaceConfig as KukaSurfaceConfig, QuadrotorConfig as QuadrotorConfig, QuadrupedConfig as QuadrupedConfig,
    SCENARIOS as SCENARIOS, simulate as simulate,
)
