"""The picture of a check: what every panel of a robot whose base moves shows is that joint's own motion."""

import numpy as np

from forcegp.checks import check
from forcegp.scores import check_figure
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def test_panels_of_a_floating_base_show_their_own_joint():
    log = simulate_quadruped(QuadrupedConfig(seconds=2.0, seed=3))
    figure = check_figure(check(log))
    axes = {each.get_title(loc="left"): each for each in figure.axes}
    for name in ("front_left_roll", "rear_right_knee"):
        drawn = axes[name].lines[0].get_ydata()
        recorded = log.q[:, log.model.robot.position_names.index(name)]
        assert np.ptp(drawn) > 0.0
        np.testing.assert_allclose(drawn[0], recorded[0])
        assert recorded.min() <= drawn.min() <= drawn.max() <= recorded.max()
    height = axes["base.z"].lines[0].get_ydata()
    np.testing.assert_allclose(np.ptp(height), np.ptp(log.q[:, 2]), rtol=0.2)  # nearly level
    spectra = next(axes for axes in figure.axes if axes.get_title(loc="left").startswith("Acceleration"))
    assert spectra.get_legend() is None
    looks = {(line.get_color(), line.get_linestyle()) for line in spectra.lines}
    assert len(looks) == len(spectra.lines) == log.nv
