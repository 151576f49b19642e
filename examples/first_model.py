"""A first model: joint friction of a KUKA iiwa, learned from 100 rows. Draws friction.png."""

from forcegp import JointFriction, KukaSurfaceConfig, fit, score, simulate_kuka_surface
from forcegp.scores import friction_curves_figure, save_figure

free = {"surface": "none", "joint_friction": "stribeck"}
train = simulate_kuka_surface(KukaSurfaceConfig(seconds=6, seed=1, **free))  # or Dataset.load("log.h5")
test = simulate_kuka_surface(KukaSurfaceConfig(seconds=3, seed=2, **free))

for prior in ((), JointFriction()):
    posterior = fit(train.model.with_forces(prior), train, points=100, restarts=1)
    print(f"{type(prior).__name__}: mean absolute error {score(posterior, test).value('mae'):.2f} rad/s^2")

save_figure(friction_curves_figure(posterior, test), "friction.png")
