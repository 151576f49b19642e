"""Swing up two links: friction learned from motions, torques planned by IPOPT; docs/how-to/deploy.md explains it.

Needs `pip install 'forcegp[casadi]'`; writes swing-up.png.
"""

from swing_up_picture import picture
from swing_up_plan import plan
from true_arm import TrueArm
from two_links import HANGING, NOMINAL
from two_links_log import recorded

from forcegp import JointFriction, fit

data = recorded()
learned = fit(NOMINAL.with_forces(JointFriction()), data, points=120, restarts=1)
nominal = fit(NOMINAL, data, points=20, restarts=1)
arm, plans = TrueArm(data), {}
for title, posterior in (("planned without friction", nominal), ("planned with learned friction", learned)):
    u, states, iterations = plan(posterior)
    true = arm(HANGING, u)
    off = abs(true[:, :2] - states[:, :2]).max(1)
    print(f"{title}: {iterations} iterations, {off[-1]:.2f} rad off at the end, at most {off.max():.2f} rad")
    plans[title] = u, states, true
picture(plans)
