"""Exported C: against `predict`, as C99 without warnings, and what cannot be exported."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data, arm_model, arm_that_remembers, quick_fit
from tests.posterior.exported_program import PLAIN_AND_SANITIZED, compiled, ran

from forcegp import ContactMonitor, Dataset, Model, Robot, export_c
from forcegp.codegen.c_writer import write_function
from forcegp.errors import InvalidInput, NumericalError
from forcegp.fit import fit
from forcegp.forces import ContactFriction, JointForces, JointFriction
from forcegp.posterior import Posterior, c_files
from forcegp.posterior.c_export import rounding
from forcegp.posterior.c_files import identifier

DT = 0.02

pytestmark = pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")


def call(function, sizes, *arrays) -> tuple[int, list[np.ndarray]]:
    given, made = [np.ascontiguousarray(x, dtype=float) for x in arrays], [np.full(size, 7.0) for size in sizes]
    return function(*(ctypes.c_void_p(x.ctypes.data) for x in (*given, *made))), made


@pytest.fixture(scope="module")
def friction() -> Posterior:
    return quick_fit(arm_model().with_forces(JointFriction(), ContactFriction(load=True, expected=0.2)))


ONE = """<robot name="Größe */ 1"><link name="base"/><link name="l"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="*/ int" type="continuous"><parent link="base"/><child link="l"/><axis xyz="0 1 0"/></joint></robot>"""


def test_one_joint_with_any_name_compiles_without_a_warning(tmp_path):
    model = Model(Robot.from_urdf_text(ONE))
    q, v, u = np.random.default_rng(0).normal(size=(3, 12, 1))
    data = Dataset(q=q, v=v, u=u, a=u - v, time=np.arange(12.0), model=model, noise_std=[0.1])
    model = quick_fit(model.with_forces(JointForces()), data, 1)
    made = export_c(model, tmp_path / "one", covariance=True, jacobian=True, steps=DT, integrator="implicit-midpoint")
    function = compiled(tmp_path / "one", f"{made.name}.c").gr_e_1_mean_covariance
    _, (a, spread) = call(function, [1, 1], q[0], v[0], u[0])
    np.testing.assert_allclose(a, model.predict(q, v, u).mean[0], rtol=1e-10)
    assert 0.0 < spread[0] < 1e3


@pytest.fixture(scope="module")
def complete(posterior, tmp_path_factory) -> Path:
    """Everything that can be written of a model."""
    folder = tmp_path_factory.mktemp("complete") / "arm"
    export_c(posterior, folder, covariance=True, jacobian=True, steps=DT, integrator="rk4", source="models/*/run?")
    return folder


@pytest.mark.nightly
def test_what_is_said_of_a_program_is_what_it_was(complete, friction, tmp_path):
    export_c(friction, tmp_path / "other", covariance=True, name="other")
    texts = {path.name: path.read_text() for path in (complete / "arm.h", tmp_path / "other" / "other.h")}
    lines = {name: re.sub(r".*(\de-\d|written by).*", "", text).splitlines() for name, text in texts.items()}
    assert_unchanged("posterior/headers", lines)


@pytest.fixture(scope="module")
def library(complete) -> ctypes.CDLL:
    return compiled(complete, "arm.c", optimized=1)  # some warnings need it


@pytest.fixture(scope="module")
def states() -> list[np.ndarray]:
    data = arm_data(5, 1)
    return [data.q, data.v, data.u]


def test_every_function_computes_what_the_model_does(posterior, library, states):
    predicted, reference = posterior.predict(*states), posterior.predictor(compile=False)
    covariance, linear = reference(*states)[1], reference.linearize(*states)
    step = reference.linearize_step(*states, DT, "rk4")
    for k in range(5):
        at = [x[k] for x in states]
        bits, (a,) = call(library.arm_mean, [3], *at)
        assert bits == 0
        np.testing.assert_allclose(a, predicted.mean[k], rtol=1e-11, atol=1e-11)
        _, (a, spread) = call(library.arm_mean_covariance, [3, 9], *at)
        np.testing.assert_allclose(a, predicted.mean[k], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(spread.reshape(3, 3), covariance[k], rtol=1e-7, atol=1e-9)
        exact, wider = predicted.covariance[k].numpy(), spread.reshape(3, 3)
        assert np.linalg.eigvalsh(wider - exact).min() > -1e-9 * np.abs(exact).max()
        _, (_, jacobian) = call(library.arm_linearize, [3, 27], *at)
        np.testing.assert_allclose(jacobian.reshape(3, 9), torch.cat(linear[1:], -1)[k], rtol=1e-9, atol=1e-9)
        _, (q, v, A, B) = call(library.arm_step_jacobian, [3, 3, 36, 18], *at)
        for found, wanted in zip((q, v, A.reshape(6, 6), B.reshape(6, 3)), step, strict=False):
            np.testing.assert_allclose(found, wanted[k], rtol=1e-9, atol=1e-9)
        _, again = call(library.arm_step, [3, 3], *at)
        np.testing.assert_allclose(again, (q, v), rtol=1e-13)


@pytest.mark.nightly
@pytest.mark.parametrize("integrator", ["rk4", "implicit-midpoint"])
def test_steps_of_friction_and_their_derivatives(friction, states, integrator, tmp_path):
    made = export_c(friction, tmp_path / "arm", jacobian=True, steps=DT, integrator=integrator)
    library = compiled(tmp_path / "arm", "arm.c")
    step = friction.predictor(covariance="none", compile=False).linearize_step(*states, DT, integrator)
    for k in range(5):
        bits, (q, v, A, B) = call(library.arm_step_jacobian, [3, 3, 36, 18], *(x[k] for x in states))
        assert bits == 0
        for found, wanted in zip((q, v, A.reshape(6, 6), B.reshape(6, 3)), step, strict=False):
            np.testing.assert_allclose(found, wanted[k], rtol=1e-8, atol=1e-8)
    names = "mean", "linearize", "step", "step_jacobian", "inverse_dynamics", "forces"
    assert set(made.differences) == {f"arm_{name}" for name in names}
    assert max(made.differences.values()) < 1e-8


def test_the_torques_for_a_motion_and_every_force_are_those_of_the_model(friction, states, tmp_path):
    """Under a load that depends on u: Newton's method, and at a contact that is pressed."""
    export_c(friction, tmp_path / "arm", covariance=True)
    library = compiled(tmp_path / "arm", "arm.c")
    q, v, _ = states
    a = np.random.default_rng(1).normal(size=q.shape)
    wanted = friction.predictor(covariance="none", compile=False).inverse_dynamics(q, v, a, [12.0]).mean
    parts = friction.components(*states)
    for k in range(5):
        bits, (u,) = call(library.arm_inverse_dynamics, [3], q[k], v[k], a[k], [12.0], [])
        assert bits == 0
        np.testing.assert_allclose(u, wanted[k], rtol=1e-10, atol=1e-10)
        bits, (force, deviation) = call(library.arm_forces_deviation, [6, 6], *(x[k] for x in states))
        assert bits == 0
        found = dict(zip(parts, np.stack([force.reshape(-1, 3), deviation.reshape(-1, 3)], axis=1), strict=True))
        for name, part in parts.items():
            np.testing.assert_allclose(found[name][0], part.joint_force.mean[k], rtol=1e-9, atol=1e-12)
            exact = part.joint_force.covariance[k].diagonal().clamp_min(0.0).sqrt().numpy()
            assert (found[name][1] > exact * (1.0 - 1e-6) - 1e-9).all()
            np.testing.assert_allclose(found[name][1], exact, rtol=0.05, atol=1e-3)
    assert call(library.arm_inverse_dynamics, [3], q[0], v[0], [np.inf, 0.0, 0.0], [0.0], [])[0] == 1


CPP = """#include "arm.hpp"
#include <cstdio>
int main() {
  static_assert(sizeof(arm::Velocities) == 3 * sizeof(double));
  const auto found = arm::inverse_dynamics({0.1, 0.2, 0.3}, {0.5, -0.5, 0.5}, {1.0, 0.0, -1.0}, {}, MEMORY);
  arm::Monitor monitor;
  for (int k = 0; k < 3; k++) monitor.step({0.1 * k, 0.2, 0.3}, {0.5, -0.5, 0.5}, found.value);
  const auto seen = monitor.step({0.4, 0.2, 0.3}, {0.5, -0.5, 0.5}, {90.0, 0.0, 0.0});
  const auto where = monitor.place({0.4, 0.2, 0.3}, seen.torque);
  std::array<arm::Velocities, PARTS> force;
  const int bits = arm::forces({0.1, 0.2, 0.3}, {0.5, -0.5, 0.5}, {}, force);
  const auto z = arm::remember(MEMORY, {0.0, 0.0, 0.0}, {1.0, 0.0, 0.0}, 0.01);
  std::printf("%.17g %.17g %d %g %s", found.value[0], seen.distance, bits + found.status + seen.status, z[0],
              arm_links[where.link]);
}"""


@PLAIN_AND_SANITIZED
def test_friction_that_remembers_and_a_monitor_of_contacts(tmp_path, options):
    """The torques for a motion with what was remembered, the monitor sample by sample, and both from C++."""
    posterior, data = arm_that_remembers()
    rng, time = np.random.default_rng(0), np.arange(6000)[:, None] * 0.01
    q = 0.4 * np.sin(time * [0.7, 1.1, 1.3] + [0.0, 1.0, 2.0])
    v, u = np.gradient(q, 0.01, axis=0), rng.normal(size=q.shape)
    monitor = ContactMonitor(posterior.predictor(), dt=0.01).calibrate([(q, v, u)])
    made = export_c(posterior, tmp_path / "arm", covariance=True, monitor=monitor)
    assert max(made.differences[f"arm_monitor_{what}"] for what in ("step", "place")) < 1e-9
    library, z = compiled(tmp_path / "arm", "arm.c"), [0.3, -0.9, 1.0]
    wanted = posterior.predictor(covariance="none").inverse_dynamics(q[7], v[7], u[7], memory=z).mean
    bits, (found,) = call(library.arm_inverse_dynamics, [3], q[7], v[7], u[7], [], z)
    assert bits == 0
    np.testing.assert_allclose(found, wanted, rtol=1e-11)
    u[100:] += 60.0  # something pushes
    seen = monitor.run(q[:200], v[:200], u[:200])
    assert 0 < int(seen.alarm.sum()) < 100
    state = np.zeros(100)
    for k in range(200):
        torque, distance, alarm = np.zeros(3), np.zeros(1), np.zeros(1, np.int32)
        assert not library.arm_monitor_step(*map(pointer, (state, q[k], v[k], u[k], torque, distance, alarm)))
        np.testing.assert_allclose(torque, seen.torque[k], rtol=1e-9, atol=1e-12)
        assert bool(alarm) == bool(seen.alarm[k])
        np.testing.assert_allclose(distance, seen.distance[k], rtol=1e-7, atol=1e-12)
    names, place = [x.decode() for x in (ctypes.c_char_p * 3).in_dll(library, "arm_links")], Place()
    for at, torque in zip(rng.uniform(-3.0, 3.0, (50, 3)), rng.normal(0.0, [[9.0, 9.0, 0.1]], (50, 3)), strict=True):
        assert not library.arm_monitor_place(pointer(at), pointer(torque), ctypes.byref(place))
        wanted = monitor.place(at, torque)
        assert names[place.link] == wanted.link
        assert {name for name, alike in zip(names, place.also, strict=True) if alike} == {*wanted.also}
        for found, each in zip(place.numbers, (wanted.point, wanted.force, wanted.force_std), strict=True):
            np.testing.assert_allclose(found, each, rtol=1e-10, atol=1e-12)
    assert library.arm_monitor_place(pointer(at), pointer(np.array([np.nan, 0.0, 0.0])), ctypes.byref(place)) == 1
    assert place.link == -1
    with pytest.raises(InvalidInput, match="counts another covariance than the program has"):
        export_c(posterior, tmp_path / "other", monitor=monitor)
    laws = fit(posterior.model.known, data, restarts=1)
    for model in (laws.predictor(), laws.model):  # nothing is open where nothing is unknown
        known = ContactMonitor(model, dt=0.01).calibrate([(q, v, u)])
        made = export_c(laws, tmp_path / type(model).__name__, monitor=known)
        assert made.differences["arm_monitor_step"] < 1e-9
    if shutil.which("c++"):
        (tmp_path / "arm" / "main.cpp").write_text(CPP.replace("MEMORY", "{0.3, -0.9, 1.0}").replace("PARTS", "2"))
        strict = ["-std=c++17", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
        for command in (["cc", "-std=c99", "-c", "arm.c"], ["c++", *strict, "main.cpp", "arm.o", "-o", "x"]):
            subprocess.run([*command, *options], cwd=tmp_path / "arm", check=True)
        told = subprocess.run(["./x"], cwd=tmp_path / "arm", capture_output=True, text=True, check=True).stdout.split()
        given = [0.1, 0.2, 0.3], [0.5, -0.5, 0.5], [1.0, 0.0, -1.0]
        _, (again,) = call(library.arm_inverse_dynamics, [3], *given, [], z)
        assert float(told[0]) == pytest.approx(again[0], rel=1e-12)
        assert float(told[1]) > 0.0
        assert told[2] == "0"
        assert float(told[3]) == pytest.approx(1.0, abs=1e-6)  # a turn of 1 rad forgets everything
        assert told[4] in names


class Place(ctypes.Structure):
    _fields_ = (("numbers", ctypes.c_double * 3 * 3), ("link", ctypes.c_int), ("also", ctypes.c_int * 3))


def pointer(x):
    return ctypes.c_void_p(x.ctypes.data)


@PLAIN_AND_SANITIZED
@pytest.mark.nightly
def test_the_self_test_the_example_and_the_commands_of_the_readme_work(complete, tmp_path, options):
    folder = tmp_path / "copy"
    shutil.copytree(complete, folder)
    commands = [line.partition("#")[0] for line in (folder / "README.txt").read_text().splitlines() if "cc " in line]
    assert len(commands) == 2
    for command in commands:
        quick = command.replace("-O2", "-O0")
        done = subprocess.run(quick, shell=True, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert all(ran(folder, program, "arm.c", *options).returncode == 0 for program in ("example.c", "self_test.c"))
    text = (folder / "arm.c").read_text()
    place = text.index("0x1.", text.index("table0[]"))
    (folder / "arm.c").write_text(f"{text[:place]}-{text[place:]}")  # one weight or centre of the model
    broken = ran(folder, "self_test.c", "arm.c")
    assert broken.returncode == 1
    assert "differs by" in broken.stdout


def test_what_is_not_finite_is_reported(library, states):
    q, v, u = (x[0].copy() for x in states)
    v[1] = np.nan
    bits, (a, jacobian) = call(library.arm_linearize, [3, 27], q, v, u)
    assert bits == 1
    assert np.isnan(a).all()
    assert np.isnan(jacobian).all()
    bits, (a,) = call(library.arm_mean, [3], q, [1e200, 0.0, 0.0], u)  # squares of it are not finite
    assert bits == 4


def test_an_implicit_step_that_is_not_found_is_reported_as_such(friction, states, tmp_path):
    export_c(friction, tmp_path / "arm", steps=DT, integrator="implicit-midpoint", unchecked=True)
    source = tmp_path / "arm" / "arm.c"
    text = source.read_text()
    assert "ROUNDS = 60" in text
    source.write_text(text.replace("ROUNDS = 60", "ROUNDS = 1"))  # Newton's method needs more
    step = compiled(tmp_path / "arm", "arm.c").arm_step
    bits, (_, v) = call(step, [3, 3], *(x[0] for x in states))
    assert bits == 8
    assert np.isnan(v).any()
    assert "arm_STEP_NOT_FOUND = 8" in (tmp_path / "arm" / "arm.h").read_text()
    assert call(step, [3, 3], states[0][0], [1e200, 0.0, 0.0], states[2][0])[0] == 4


def test_sums_that_cancel_may_differ_by_their_rounding(tmp_path, states):
    """Without an analytical mean, processes sum gravity and inertia up from terms thousands of times as large."""
    smooth = quick_fit(arm_model().with_forces(JointForces()).without_mean(), arm_data(60, 0), 60)
    q, v, u = (x[None] if x.dim() == 1 else x for x in [torch.tensor(x) for x in states])
    dynamics = smooth.dynamics(q, v, u)
    W = dynamics.H @ smooth.model.unknown.direction(dynamics)
    features, latent = smooth.likelihood.standardization(smooth.model.unknown.features(dynamics)), smooth.latent
    terms = [
        (kernel.cross(z, at) * w).abs().sum(-1)
        for kernel, z, at, w in zip(latent.kernels.dense, features, latent.features, latent.weights, strict=True)
    ]
    largest = (W.abs() @ torch.stack(terms, dim=-1)[..., None]).max() / smooth.predict(q, v, u).mean.abs().max()
    assert rounding(smooth, q, v, u) == pytest.approx(2.0**-52 * float(largest), rel=1e-6)
    assert 5e-12 < rounding(smooth, q, v, u) < 1e-6
    assert export_c(smooth, tmp_path / "arm").differences["arm_mean"] < 1e-7


def test_a_program_that_differs_is_not_written(posterior, tmp_path, monkeypatch):
    one_off = "  y[0] = ", "  y[0] = 1e-6 + "
    monkeypatch.setattr(c_files, "write_function", lambda *given: write_function(*given).replace(*one_off))
    with pytest.raises(NumericalError, match=r"arm_mean of the compiled program and forcegp differ by .* nothing was"):
        export_c(posterior, tmp_path / "arm")
    assert list(tmp_path.iterdir()) == []
    assert export_c(posterior, tmp_path / "arm", unchecked=True).differences == {}
    assert "was not compared with forcegp" in (tmp_path / "arm" / "arm.h").read_text()


def test_without_a_compiler_it_is_written_and_says_that_nothing_was_compared(posterior, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.warns(UserWarning, match="was not compared with forcegp: .*'no-such-compiler'"):
        made = export_c(posterior, tmp_path / "arm")
    assert made.differences == {}
    assert (tmp_path / "arm" / "arm.c").exists()


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("LBR-iiwa 7", "lbr_iiwa_7"), ("7dof", "robot_7dof"), ("", "robot"), ("math", "math_model"),
        *((x, f"{x}_model") for x in ("new", "log", "id_t")), ("über-Arm 2", "ber_arm_2"), ("a" * 300, "a" * 60),
    ],
)  # fmt: skip
def test_names_for_c(given, found):
    assert identifier(given) == found


@pytest.mark.nightly
@pytest.mark.skipif(not shutil.which("cmake"), reason="needs CMake")
def test_cmake_builds_and_tests(complete, tmp_path):
    for command in (["-S", str(complete), "-B", "."], ["--build", "."]):
        done = subprocess.run(["cmake", *command], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert subprocess.run(["ctest"], cwd=tmp_path, capture_output=True, check=False).returncode == 0
    assert (tmp_path / "libarm.a").exists()
    subprocess.run(["cmake", "--install", ".", "--prefix", str(tmp_path / "there")], cwd=tmp_path, check=True)
    (mine := tmp_path / "mine").mkdir()
    (mine / "main.cpp").write_text(
        '#include "arm.hpp"\nint main() { return arm::forward_dynamics({}, {}, {}).status; }'
    )
    (mine / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.10)\nproject(mine CXX)\nset(CMAKE_CXX_STANDARD 17)\n"
        "find_package(arm REQUIRED)\nadd_executable(mine main.cpp)\ntarget_link_libraries(mine arm::model)\n"
    )
    for command in (["-S", ".", "-B", "b", f"-DCMAKE_PREFIX_PATH={tmp_path / 'there'}"], ["--build", "b"]):
        subprocess.run(["cmake", *command], cwd=mine, check=True, capture_output=True)
    assert subprocess.run([mine / "b" / "mine"], check=False).returncode == 0
