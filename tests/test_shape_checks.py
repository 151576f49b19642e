"""`FORCEGP_CHECK_SHAPES=1`, which `make test-all` sets, makes a wrong shape in a signature an error.

The last test does so in the fast tier for what users do with two robots, whose sizes of q, v and u are equal in one of
them and all different in the other: what only `make test-all` would find goes wrong unseen.
"""

import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch
from tests.models.arm import arm_data
from tests.models.test_predictor_of_moving_bases import hopper

from forcegp import (
    Dataset,
    JointForces,
    JointFriction,
    Noise,
    StructuredGP,
    check,
    evaluate,
    load_posterior,
    save_posterior,
)


def checked(repository: Path, code: str) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join([str(repository), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "FORCEGP_CHECK_SHAPES": "1", "PYTHONPATH": paths}
    command = [sys.executable, "-c", "import tests.conftest\n" + code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def hopper_data(rows: int) -> Dataset:
    """Of a floating base with two propellers and a foot that is held in every second row: each size is another."""
    system, generator = hopper("floating"), torch.Generator().manual_seed(0)
    q = system.robot.random(generator, rows)
    v, u = (torch.randn(rows, size, generator=generator).double() for size in system.sizes[1:])
    u[:, -1] = torch.arange(rows) % 2
    a = system.dynamics(q, v, u).acceleration(-0.3 * v)
    given = {name: x.numpy() for name, x in zip("qvua", (q, v, u, a), strict=True)}
    return Dataset(**given, time=0.01 * np.arange(rows), system=system)


def whole_way() -> None:
    """Robot, Dataset, fit, predictions, motions, files; the program in C of the arm alone, as it takes long."""
    warnings.simplefilter("ignore")
    for data, prior, compiled in ((arm_data(64, 0), JointForces(), True), (hopper_data(64), JointFriction(), False)):
        print(data.system.sizes)
        check(data)
        posterior = StructuredGP(data.system, prior, noise=Noise(0.05)).fit(data, points=64, restarts=1)
        evaluate(posterior, data)
        with tempfile.TemporaryDirectory() as folder:
            data.save(f"{folder}/data.h5")
            save_posterior(posterior, f"{folder}/model")
            posterior, data = load_posterior(f"{folder}/model"), Dataset.load(f"{folder}/data.h5")
        states = [torch.tensor(x[:5]) for x in (data.q, data.v, data.u)]
        posterior.components(*states)
        predictor = posterior.update(data[:2]).predictor(covariance="none", compile=compiled)
        predictor.linearize(*states)
        predictor.rollouts(*(x[:2] for x in states[:2]), states[2].expand(2, 5, -1), 0.01)
        posterior.rollout(*(x[0] for x in states[:2]), states[2], 0.01, samples=2, seed=0).interval()


def test_a_wrong_shape_is_refused_where_that_was_asked_for(repository):
    code = (
        "import torch; from jaxtyping import TypeCheckError\n"
        "from forcegp.mechanics.surfaces import surface_axes\n"
        "try: surface_axes(torch.ones(4, dtype=torch.float64))\n"
        "except TypeCheckError as error: print('surface_axes' in str(error))\n"
    )
    done = checked(repository, code)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


def test_right_shapes_pass_from_the_robot_to_its_predicted_motions(repository):
    done = checked(repository, "from tests.test_shape_checks import whole_way; whole_way()")
    assert (done.returncode, done.stdout) == (0, "(3, 3, 3)\n(8, 7, 4)\n"), done.stderr
