"""A prior of your own: dry friction whose level depends on the angle of the joint, as in a rough gear."""

from dataclasses import asdict, dataclass

import torch
from two_links import NOMINAL

from forcegp import Dataset, JointFriction, fit, score
from forcegp.forces import Unknown, kernel_of


@dataclass(frozen=True)
class RoughGear(Unknown):  # Q_U,j = -tanh(v_j / width) f_j(q_j)
    width: float = 0.1  # rad/s

    def latent_names(self, robot):
        return robot.joint_names

    def direction(self, dynamics):
        return -torch.diag_embed(torch.tanh(dynamics.state.v / self.width))

    def features(self, dynamics):
        return dynamics.state.q.split(1, dim=-1)

    def kernels(self, robot, dimensions, variances):
        return tuple(kernel_of("constant + squared-exponential", 1, variance) for variance in variances)

    def to_dict(self):
        return asdict(self)


q, v, u = torch.randn(3, 400, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
a = NOMINAL.dynamics(q, v, u).acceleration(-torch.tanh(v / 0.1) * (0.2 + 0.1 * torch.cos(3 * q)))
rows = {"q": q, "v": v, "u": u, "a": a, "time": 0.01 * torch.arange(400)}
log = Dataset(**{name: x.numpy() for name, x in rows.items()}, model=NOMINAL, noise_std=[0.1, 0.1])
train, test = log.rows(slice(0, 200)), log.rows(slice(200, 400))
for prior in (JointFriction(), RoughGear()):
    posterior = fit(NOMINAL.with_forces(prior), train, points=60, restarts=1)
    print(f"{type(prior).__name__}: mean absolute error {score(posterior, test).value('mae'):.2f} rad/s^2")
