"""Published numbers of the paper: its curves, read from its vector graphics, and those of its text.

Rath, Geist & Trimpe (2021), "Using Physics Knowledge for Learning Rigid-body Forward Dynamics with Gaussian Process
Force Priors", CoRL.
"""

FIG2B_POINTS: tuple[int, ...] = (100, 200, 400, 600, 800, 1000)
_MAE = {
    "gp": (0.4497, 0.2792, 0.1682, 0.1377, 0.1232, 0.1161),
    "s-gp-38": (0.3987, 0.2469, 0.1523, 0.1288, 0.1175, 0.1111),
    "s-gp": (0.5856, 0.2092, 0.1193, 0.1049, 0.1006, 0.0977),
    "s-gp-mean": (0.1051, 0.0936, 0.0868, 0.0855, 0.0847, 0.0844),
}
FIG2B_MAE: dict[str, dict[int, float]] = {
    model: dict(zip(FIG2B_POINTS, values, strict=True)) for model, values in _MAE.items()
}
"""Mean absolute error against noisy accelerations [rad/s^2], mean over the joints, by number of training points."""

FIG2B_CONSTRAINT_ERROR = {
    "gp": dict(zip(FIG2B_POINTS, (0.229, 0.155, 0.087, 0.053, 0.041, 0.036), strict=True)),
    "s-gp": dict.fromkeys(FIG2B_POINTS, 3e-12),
}
"""Mean |A a - b| [m/s^2] of the predicted mean; for S-GP the paper shows about 3e-12 throughout."""

MAE_10000 = {"analytical": 0.57}  # the same error with 10,000 points

NOISE_STD = 0.1  # of the measured acceleration [rad/s^2]; a perfect model has the MAE 0.1 sqrt(2 / pi) = 0.0798
