"""What does the robot hold? A UR5 in MuJoCo carries 0.7 kg at (20, 0, 50) mm that its URDF lacks.

Needs `pip install 'forcegp[mujoco]'`.
"""

import numpy as np
from ur5_log import URDF, recorded

from forcegp import Dataset, Model, Offset, Payload, Robot, Rotor, Stribeck, Viscous, fit
from forcegp.data import Preparation

time, q, v, u = np.split(recorded(seconds=12.0), [1, 7, 13], axis=1)
a = np.gradient(v, time[:, 0], axis=0)
log = Dataset(q=q, v=v, u=u, a=a, time=time[:, 0], model=Model(Robot.from_urdf_text(URDF)))
data = Preparation(cutoff=12.0, every=13, trim=0.1).apply(log)

model = data.model.with_forces(Viscous(), Stribeck(), Offset(), Rotor(), Payload("tool0"))
found = fit(model, data).parameters
x, y, z = (1e3 * found[f"payload.center_of_mass.{axis}"].value for axis in "xyz")
print(f"{found['payload.mass'].value:.3f} +- {2 * found['payload.mass'].std:.3f} kg at ({x:.0f}, {y:.0f}, {z:.0f}) mm")
