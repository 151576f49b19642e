"""Compiled dynamics: the robot's results, kept in a folder, with errors that say what to do."""

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from tests.inference.problems import normal as random
from tests.robots.robot_models import TREE
from tests.robots.test_moving_bases import LIMBS

from forcegp.codegen.c_writer import write_program
from forcegp.codegen.graph import ZERO
from forcegp.codegen.library import RowFunction, compile_library
from forcegp.errors import CompilerError, InvalidInput, NumericalError
from forcegp.robots import Robot
from forcegp.robots.compiled import trace_dynamics

ARMATURE = {"a_hip": 0.2, "b_slide": 0.4}
METHODS = {
    "mass_matrix": 1, "bias_forces": 2, "mass_matrix_and_bias": 2, "gravity_forces": 1, "inverse_dynamics": 3,
    "forward_dynamics": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def robot():
    return Robot.from_urdf_text(LIMBS, armature=ARMATURE, base="fixed")  # a branch, a slide, skew axes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("compiled") / "dynamics"


@pytest.fixture(scope="module")
def compiled(robot, folder):
    return robot.compile(folder)


@pytest.mark.parametrize("method", METHODS)
def test_values_equal_those_of_the_robot(robot, compiled, method):
    arguments = [random(5, 6, 3, seed=k) for k in range(METHODS[method])]
    ours, theirs = (getattr(of, method)(*arguments) for of in (compiled, robot))
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (5, 6, 3)])
def test_motions_of_a_point_equal_those_of_the_robot(robot, compiled, shape):
    state = random(*shape), random(*shape, seed=1)
    for frame, point in (("a_foot", (0.1, 0.0, 0.2)), ("a_foot", (0.1, 0.0, 0.3)), ("a_thigh", (0.1, 0.0, 0.2))):
        ours, theirs = (of.frame_motion(*state, frame, point) for of in (compiled, robot))
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("lanes", "statements"), [(1, 500), (2, 500), (8, 500), (4, 40), (4, 10**6)])
def test_other_widths_of_vector_registers_and_parts(robot, tmp_path, lanes, statements):
    """What is written for other processors runs here, too, only slower; parts of any length do the same."""
    inputs, outputs = list(random(3, 13, 3)), [torch.full((13, 3), torch.nan, dtype=torch.float64)]
    source = write_program(trace_dynamics(robot, "forward_dynamics"), lanes, statements)
    library = compile_library(source, ("-std=gnu11", "-O1", "-fPIC", "-shared"), tmp_path / "one.so", "evaluate")
    assert RowFunction(library, 3, [3]).rows(inputs, outputs) == 0
    torch.testing.assert_close(outputs[0], robot.forward_dynamics(*inputs))


def test_large_batches_by_several_threads(robot, compiled):
    q, v, tau = random(3, 5000, 3)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        values = compiled.forward_dynamics(q, v, tau)
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(values, robot.forward_dynamics(q, v, tau))


def test_another_process_finds_the_code(robot, folder, compiled, repository):
    compiled.forward_dynamics(*random(3, 1, 3))
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    script = """
import pickle, sys, torch
compiled = pickle.load(sys.stdin.buffer)
q, v, tau = torch.full((3, 3), 0.3, dtype=torch.float64)
print(compiled.forward_dynamics(q, v, tau).tolist())
"""
    environment, command = os.environ | {"CC": "no-compiler-at-all"}, [sys.executable, "-c", script]
    done = subprocess.run(command, input=pickle.dumps(compiled), capture_output=True, check=True, env=environment)
    assert eval(done.stdout) == compiled.forward_dynamics(*torch.full((3, 3), 0.3, dtype=torch.float64)).tolist()
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert all(path.suffix == ".so" for path in before)  # nothing unfinished lies about


def test_what_is_not_supported_says_so(robot, compiled):
    with pytest.raises(InvalidInput, match=r"no derivatives; .*compiled\.robot"):
        compiled.gravity_forces(random(3).requires_grad_())
    with pytest.raises(InvalidInput, match=r"does not support transforms of torch\.func"):
        torch.func.vmap(compiled.gravity_forces)(random(2, 3))
    with (
        torch.autograd.forward_ad.dual_level(),
        pytest.raises(InvalidInput, match="does not support forward-mode differentiation"),
    ):
        compiled.gravity_forces(torch.autograd.forward_ad.make_dual(random(3), random(3)))
    with pytest.raises(InvalidInput, match=r"runs on the CPU, .*robot\.to\('cpu'\)"):
        robot.to("meta").compile()


def test_what_cannot_be_loaded_never_enters_the_folder(robot, tmp_path, monkeypatch):
    broken = tmp_path / "broken"
    broken.write_text('#!/bin/sh\nwhile [ "$1" != -o ]; do shift; done\necho "no library" > "$2"\n')
    broken.chmod(0o700)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(CompilerError, match=r"cannot be loaded .*robot\.compile\(folder=\.\.\.\)"):
        robot.compile(tmp_path / "dynamics").gravity_forces(random(3))
    assert list((tmp_path / "dynamics").iterdir()) == []
    monkeypatch.delenv("CC")
    robot.compile(tmp_path / "dynamics").gravity_forces(random(3))


def test_structure_stays_structure():
    """Joints on different branches are coupled by a zero that costs nothing."""
    robot = Robot.from_urdf_text(TREE)
    M = np.reshape(trace_dynamics(robot, "mass_matrix").outputs["result 0"], (robot.nv, robot.nv))
    assert np.array_equal(M != ZERO, robot.tree.related[..., 0].bool().numpy())


def test_a_mass_matrix_that_is_not_positive_definite_is_an_error(compiled):
    q, v, tau = random(3, 4, 3)
    q[2] = torch.nan
    with pytest.raises(NumericalError, match="not positive definite"):
        compiled.forward_dynamics(q, v, tau)
