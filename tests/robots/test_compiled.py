"""Compiled dynamics: the robot's results, kept in a folder, with errors that say what to do."""

import os
import pickle
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from forcegp.codegen.c_writer import write_program
from forcegp.codegen.library import RowFunction, compile_library
from forcegp.errors import CompilerError, InvalidInput
from forcegp.robots import Robot
from forcegp.robots.compiled import UnrolledRobot, trace_dynamics

# a branch, a slide, skew axes, a fixed link and armature, in as few joints as have them
TEXT = """<robot name="small">
  <link name="base"/>
  <joint name="swing" type="revolute">
    <origin xyz="0.1 0 0.4" rpy="0.3 0.2 -0.5"/><parent link="base"/><child link="arm"/><axis xyz="1 2 -1"/>
    <limit lower="-2" upper="2" effort="50" velocity="3"/>
  </joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0.2 0.1 0" rpy="0 0.7 0"/><parent link="arm"/><child link="cart"/><axis xyz="0 1 1"/>
    <limit lower="-1" upper="1" effort="50" velocity="3"/>
  </joint>
  <joint name="turn" type="continuous">
    <origin xyz="-0.2 0.1 0.3"/><parent link="arm"/><child link="hand"/>
  </joint>
  <joint name="mount" type="fixed">
    <origin xyz="0 0.1 0.05" rpy="0.4 0 0"/><parent link="hand"/><child link="tool"/>
  </joint>
  <link name="arm"><inertial><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0"/><mass value="3"/>
    <inertia ixx="0.04" ixy="0.002" ixz="0" iyy="0.05" iyz="-0.003" izz="0.03"/></inertial></link>
  <link name="cart"><inertial><origin xyz="0 0.1 0"/><mass value="1.2"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.012" iyz="0" izz="0.009"/></inertial></link>
  <link name="hand"><inertial><origin xyz="0.03 0.02 0.1"/><mass value="0.8"/>
    <inertia ixx="0.004" ixy="0" ixz="0.0005" iyy="0.005" iyz="0" izz="0.003"/></inertial></link>
  <link name="tool"><inertial><origin xyz="0 0 0.05"/><mass value="0.3"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.0012" iyz="0" izz="0.0008"/></inertial></link>
</robot>
"""
ARMATURE = {"swing": 0.2, "slide": 0.4}
METHODS = {
    "mass_matrix": 1,
    "bias_forces": 2,
    "mass_matrix_and_bias": 2,
    "gravity_forces": 1,
    "inverse_dynamics": 3,
    "forward_dynamics": 3,
}


@pytest.fixture(scope="module")
def robot():
    return Robot.from_urdf_text(TEXT, armature=ARMATURE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("compiled") / "dynamics"


@pytest.fixture(scope="module")
def compiled(robot, folder):
    return robot.compile(folder)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("method", METHODS)
def test_values_equal_those_of_the_robot(robot, compiled, method):
    arguments = [random(5, 6, 3, seed=k) for k in range(METHODS[method])]
    ours, theirs = (getattr(of, method)(*arguments) for of in (compiled, robot))
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("lanes", "statements"), [(1, 500), (2, 500), (8, 500), (4, 40), (4, 10**6)])
def test_other_widths_of_vector_registers_and_parts(robot, tmp_path, lanes, statements):
    """What is written for other processors runs here, too, only slower; parts of any length do the same."""
    inputs, outputs = list(random(3, 13, 3)), [torch.full((13, 3), torch.nan, dtype=torch.float64)]
    source = write_program(trace_dynamics(UnrolledRobot(robot), "forward_dynamics"), lanes, statements)
    options = ("-std=gnu11", "-O1", "-fPIC", "-shared")
    library = compile_library(source, options, tmp_path / "one.so", "evaluate")
    assert RowFunction(library, 3, [3]).rows(13, inputs, outputs) == 0
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
    environment = os.environ | {"CC": "no-compiler-at-all"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, input=pickle.dumps(compiled), capture_output=True, check=True, env=environment)
    assert eval(done.stdout) == compiled.forward_dynamics(*torch.full((3, 3), 0.3, dtype=torch.float64)).tolist()
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert all(path.suffix == ".so" for path in before)  # nothing unfinished lies about


def test_default_folder(robot, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert robot.compile().folder == tmp_path / "forcegp" / "compiled"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert robot.compile().folder == Path.home() / ".cache" / "forcegp" / "compiled"


# ---------------------------------------------------------------------- what cannot be


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


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o722])
def test_folders_in_folders_that_others_can_write_to(robot, tmp_path, mode):
    shared = tmp_path / "shared"
    own = shared / "mine" / "dynamics"
    own.mkdir(parents=True, mode=0o700)
    shared.chmod(mode)
    link = tmp_path / "link"
    link.symlink_to(own)
    for folder in (own, link, shared / "new"):
        with pytest.raises(CompilerError, match=r"shared .*chmod go-w .*shared\)"):
            robot.compile(folder).gravity_forces(random(3))
    assert not (shared / "new").exists()
    assert list(own.iterdir()) == []
    shared.chmod(mode | stat.S_ISVTX)  # as /tmp: nobody can exchange what is there
    robot.compile(own).gravity_forces(random(3))
    assert len(list(own.iterdir())) == 1
    with pytest.raises(CompilerError, match="shared can be written to by others"):  # not the folder of the files itself
        robot.compile(shared).gravity_forces(random(3))


def test_folders_of_others(robot, tmp_path):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    try:
        os.chown(theirs, os.getuid() + 12345, -1)
    except PermissionError:
        pytest.skip("only root may give a folder away")
    with pytest.raises(CompilerError, match=r"theirs .*another user"):
        robot.compile(theirs / "mine").gravity_forces(random(3))


def test_missing_folders_are_made_for_the_user_alone(robot, tmp_path):
    before = os.umask(0)
    try:
        robot.compile(tmp_path / "a" / "b" / "c").gravity_forces(random(3))
    finally:
        os.umask(before)
    made = [tmp_path / "a", tmp_path / "a" / "b", tmp_path / "a" / "b" / "c"]
    assert [stat.S_IMODE(folder.stat().st_mode) for folder in made] == [0o700] * 3


def test_files_that_are_not_whole_or_not_ones_own(robot, tmp_path):
    robot.compile(tmp_path).gravity_forces(random(3))
    (path,) = tmp_path.iterdir()
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    path.chmod(0o722)
    with pytest.raises(CompilerError, match="can be written to by others"):
        robot.compile(tmp_path).gravity_forces(random(3))
    other = tmp_path / "other"
    other.mkdir(mode=0o700)
    (other / path.name).write_bytes(b"half a library")
    with pytest.raises(CompilerError, match=r"cannot be loaded .*delete"):
        robot.compile(other).gravity_forces(random(3))
