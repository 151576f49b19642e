"""`FORCEGP_CHECK_SHAPES=1`, which `make test-all` sets, makes a wrong shape in a signature an error (`shapes.py`).

The last test does so in the fast tier for what users do with two robots, whose sizes of q, v and u are equal in one of
them and all different in the other: what only `make test-all` would find goes wrong unseen.
"""

import os
import re
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from tests.posterior.arm import arm_data
from tests.posterior.test_predictor_of_moving_bases import hopper
from tests.robots.random_positions import random_positions
from tests.shapes import MisfitError, checked, unchecked
from torch import Tensor

from forcegp import Dataset, JointForces, JointFriction, Noise, Viscous, check, fit, load_posterior, save_posterior
from forcegp.errors import InvalidInput
from forcegp.inference import OptimizerOptions
from forcegp.mechanics.surfaces import surface_axes
from forcegp.scores import score, split_named

QUICK = OptimizerOptions(iterations=2)


def hopper_data(rows: int) -> Dataset:
    """Of a floating base with two propellers and a foot that is held in every second row: each size is another."""
    model, generator = hopper(), torch.Generator().manual_seed(0)
    q = random_positions(model.robot, generator, rows)
    v, u = (torch.randn(rows, size, generator=generator).double() for size in model.sizes[1:])
    u[:, -1] = torch.arange(rows) % 2
    a = model.dynamics(q, v, u).acceleration(-0.3 * v)
    given = {name: x.numpy() for name, x in zip("qvua", (q, v, u, a), strict=True)}
    return Dataset(**given, time=0.01 * np.arange(rows), model=model)


def whole_way() -> None:
    """Robot, Dataset, fit, predictions, motions, files; the program in C of the arm alone, as it takes long."""
    with pytest.raises(MisfitError, match="surface_axes"):
        surface_axes(torch.ones(4, dtype=torch.float64))
    warnings.simplefilter("ignore")
    for data, prior, compiled in ((arm_data(64, 0), JointForces(), True), (hopper_data(64), JointFriction(), False)):
        print(data.model.sizes)
        check(data)
        free = replace(data, model=data.model.with_contacts(()), truth={}) if compiled else data
        fit(free.model.with_forces(Viscous()), free).predict(free.q, free.v, free.u)
        models = {"one": data.model.with_forces(prior), "none": data.model.with_forces()}
        score(models, data, split=split_named(data, "blocks:4:4", guard=0.0), points=20, restarts=1, iterations=3)
        if compiled:  # a black box has no columns of feet
            score(fit(data.model.black_box(), data, points=20, restarts=1, options=QUICK), data, horizons=())
        posterior = fit(data.model.with_forces(prior, noise=Noise(0.05)), data, points=40, restarts=1, options=QUICK)
        score(posterior, data, horizons=())
        with tempfile.TemporaryDirectory() as folder:
            data.save(f"{folder}/data.h5")
            save_posterior(posterior, f"{folder}/model")
            posterior, data = load_posterior(f"{folder}/model"), Dataset.load(f"{folder}/data.h5")
        states = [torch.tensor(x[:5]) for x in (data.q, data.v, data.u)]
        posterior.components(*states)
        predictor = posterior.update(data.rows([0, 1])).predictor(covariance="none", compile=compiled)
        predictor.linearize(*states)
        predictor.rollouts(*(x[:2] for x in states[:2]), states[2].expand(2, 5, -1), 0.01)
        posterior.rollout(*(x[0] for x in states[:2]), states[2], 0.01, samples=2, seed=0).interval()


@checked
def length(x: Float[Tensor, " n"], scale: float = 1.0) -> Float[Tensor, ""]:
    """Refuses one number; of a matrix it gives as many lengths as that has rows."""
    if x.dim() == 0:
        raise InvalidInput("x is a number; give a vector.")
    return scale * x.norm(dim=-1)


@checked
def length_of_rows(x: Float[Tensor, "rows n"]) -> Float[Tensor, ""]:
    return length(x)


@checked
def lengths(x: Float[Tensor, "rows n"]) -> Float[Tensor, ""]:
    return x.norm(dim=-1)


@checked
@dataclass(frozen=True)
class Weights:
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.values == "none":
            raise InvalidInput("values is 'none'; give numbers.")
        if isinstance(self.values, list):
            object.__setattr__(self, "values", tuple(self.values))


def test_what_does_not_fit_must_be_refused_by_the_function_itself():
    assert length(torch.ones(4), scale=2) == 4.0
    with pytest.raises(InvalidInput, match="give a vector"):
        length(torch.ones(()))
    for call in (lambda: length(torch.ones(2, 3)), lambda: length("abc"), lambda: length(torch.ones(3), scale="x")):
        with pytest.raises(MisfitError, match=r"parameters of .*length"):
            call()
    with pytest.raises(MisfitError, match=r"parameters of .*\.length\."):  # the one inside
        length_of_rows(torch.ones(2, 3))
    with pytest.raises(MisfitError, match=r"return value of .*length"):
        lengths(torch.ones(2, 3))
    with unchecked():
        assert length(torch.ones(2, 4)).tolist() == [2.0, 2.0]
    with pytest.raises(MisfitError):  # checked again
        length(torch.ones(2, 3))


SIZES = {"q": "nq", "v": "nv", "a": "nv", "u": "nu"}
ARMS = {
    "control/informative_motions", "forces/columns", "simulation/trajectory", "simulation/kuka_motion"
}  # fmt: skip
"""Modules of robots that are bolted to the world and driven in every joint, where these sizes are one."""


def test_signatures_give_positions_nq_entries_and_inputs_nu(repository):
    package = repository / "src" / "forcegp"
    sources = {str(path.relative_to(package).with_suffix("")): path.read_text() for path in package.rglob("*.py")}
    named = dict(re.findall(r'^(\w+) = Float\[[\w.]+, "(.+)"\]$', "\n".join(sources.values()), re.MULTILINE))
    seen = 0
    for module in sources.keys() - ARMS:
        for name, shape, alias in re.findall(r'\b([qvau])\d?: (?:Float\[[\w.]+, "([^"]+)"|(\w+))', sources[module]):
            size = (shape or named.get(alias, "")).split()[-1:]
            seen += size == [SIZES[name]]
            assert size == [SIZES[name]] or size not in (["nq"], ["nv"], ["nu"]), (module, name, shape or alias)
    assert seen > 100


def test_the_fields_of_a_dataclass_are_checked_once_they_are_there():
    assert Weights([1, 2]) == Weights((1, 2))
    with pytest.raises(InvalidInput, match="give numbers"):
        Weights("none")
    with pytest.raises(MisfitError, match=r"Weights\.values is 'all'"):
        Weights("all")


@pytest.mark.nightly
def test_a_wrong_shape_is_refused_and_right_ones_pass_from_the_robot_to_its_predicted_motions(repository):
    paths = os.pathsep.join([str(repository), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "FORCEGP_CHECK_SHAPES": "1", "PYTHONPATH": paths}
    code = "import tests.conftest; from tests.test_shape_checks import whole_way; whole_way()"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "(3, 3, 3)\n(8, 7, 4)\n"), done.stderr
