"""The controller of examples/ros2_control, compiled against headers of our own, beside `ComputedTorque`."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tests.posterior.arm import arm_that_remembers

from forcegp import ComputedTorque, export_c

HERE = Path(__file__).parent
EXAMPLE = HERE.parent / "examples" / "ros2_control"
HEADERS = (
    "controller_interface/controller_interface", "pluginlib/class_list_macros", "realtime_tools/realtime_buffer",
    "trajectory_msgs/msg/joint_trajectory_point",
)  # fmt: skip

pytestmark = pytest.mark.skipif(not (shutil.which("cc") and shutil.which("c++")), reason="needs a C++ compiler")


def test_the_controller_commands_what_computed_torque_does(tmp_path):
    posterior, _ = arm_that_remembers()
    export_c(posterior, tmp_path / "model")
    for header in HEADERS:
        (tmp_path / header).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{header}.hpp").write_text('#include "stubs.hpp"\n')
    (tmp_path / "model.hpp").write_text('#pragma once\n#include "arm.hpp"\nnamespace model = arm;\n')
    where = [f"-I{place}" for place in (tmp_path, tmp_path / "model", HERE / "ros2_control", EXAMPLE / "include")]
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Werror", "-DFORCEGP_REMEMBERS"]
    subprocess.run(["cc", "-std=c99", "-O1", "-c", "arm.c"], cwd=tmp_path / "model", check=True)
    sources = [EXAMPLE / "src" / "controller.cpp", HERE / "ros2_control" / "manager.cpp", "model/arm.o"]
    subprocess.run(["c++", *strict, *where, *map(str, sources), "-o", "manager"], cwd=tmp_path, check=True)

    rng, time = np.random.default_rng(0), np.arange(50)[:, None] * 0.02
    q_d = 0.4 * np.sin(3.0 * time + [0.0, 1.0, 2.0])
    v_d, a_d = 1.2 * np.cos(3.0 * time + [0.0, 1.0, 2.0]), -9.0 * q_d
    q, v = q_d + 0.01 * rng.normal(size=q_d.shape), v_d + 0.1 * rng.normal(size=q_d.shape)
    rows = "\n".join(" ".join(map(repr, row)) for row in np.hstack([q, v, q_d, v_d, a_d]).tolist())
    done = subprocess.run(["./manager"], cwd=tmp_path, input=rows, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    ours = ComputedTorque(posterior.predictor(covariance="none"), stiffness=100.0, torque_limits=3.0)
    wanted = [ours(*row).numpy() for row in zip(q, v, q_d, v_d, a_d, strict=True)]
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
    assert np.abs(found).max() == 3.0  # a limit was reached


def test_the_package_names_what_it_needs():
    needs, cmake = (EXAMPLE / "package.xml").read_text(), (EXAMPLE / "CMakeLists.txt").read_text()
    for package in (header.partition("/")[0] for header in HEADERS):
        assert f"<depend>{package}</depend>" in needs
        assert package in cmake
