"""What do mass matrix, bias forces and forward dynamics cost, against Pinocchio in C++?

The Pinocchio side is a C++ loop over the batch (`crba`, in the faster of its two conventions, then `nonLinearEffects`,
or `aba`) on data allocated before, compiled with `g++ -O3 -march=native` against the installed library as this runs,
and called through ctypes: one process, one thread, both sides in turn, CPU seconds, medians. Both sides are first
checked to agree. The robot is the KUKA iiwa. The algorithms themselves are in that library, which is built for any
processor; instantiated with the loop instead, they took minutes to compile and ran 15-25 % faster.

Where it cannot be compiled (no g++, no Python or Eigen headers), there is no ratio.

glibc gives the memory of large tensors back to the system after each call until a process has freed a larger one, and
taking it again costs page faults. Any process that has fitted a model is past that, and this one is made so; "in a
fresh process" is the time before.

    python -m benchmarks.rigid_body
"""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pybullet_data
import torch
from threadpoolctl import threadpool_limits

from forcegp.robots import Robot

BATCH, REPETITIONS = 1000, 200
URDF = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"

SOURCE = """
#include <boost/python.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/rnea.hpp>
using namespace pinocchio;
typedef Eigen::Map<Eigen::VectorXd> Out;
typedef Eigen::VectorXd Vector;
typedef Eigen::Ref<const Vector> In;
template <class T> T& of(PyObject* object) { return boost::python::extract<T&>(object)(); }
typedef Eigen::Map<const Vector> Row;
static Row row(const double* values, int i, int n) { return Row(values + i * n, n); }

extern "C" void mass_and_bias(PyObject* m, PyObject* d, int count, int world, const double* q, const double* v,
                              double* M, double* b) {
  Model& model = of<Model>(m);
  Data& data = of<Data>(d);
  const int n = model.nv;
  for (int i = 0; i < count; i++) {
    const Row qi = row(q, i, n), vi = row(v, i, n);
    Eigen::Map<Eigen::MatrixXd>(M + i * n * n, n, n) =
        crba(model, data, In(qi), world ? Convention::WORLD : Convention::LOCAL);
    Out(b + i * n, n) = nonLinearEffects(model, data, In(qi), In(vi));
  }
}

extern "C" void forward_dynamics(PyObject* m, PyObject* d, int count, const double* q, const double* v,
                                 const double* tau, double* a) {
  Model& model = of<Model>(m);
  Data& data = of<Data>(d);
  const int n = model.nv;
  for (int i = 0; i < count; i++) {
    const Row qi = row(q, i, n), vi = row(v, i, n), ti = row(tau, i, n);
    Out(a + i * n, n) = aba(model, data, In(qi), In(vi), In(ti));
  }
}
"""


class States:
    """Random states of the iiwa, on both sides."""

    def __init__(self, count: int) -> None:
        self.robot = Robot.from_urdf(URDF)
        self.model = pin.buildModelFromUrdf(str(URDF))
        self.data = self.model.createData()
        rng = np.random.default_rng(0)
        self.q, self.v, self.tau = rng.normal(size=(3, count, self.robot.nv))
        self.tensors = tuple(torch.tensor(x) for x in (self.q, self.v, self.tau))


def compiled(folder: Path, text: str = SOURCE) -> ctypes.PyDLL:
    """The C++ loops of a source text, built in ``folder``."""
    prefix = Path(pin.__file__).parents[4]
    eigen = next((p for p in map(Path, _eigen_folders(prefix)) if (p / "Eigen" / "Core").exists()), None)
    if eigen is None:  # headers only; Pinocchio's wheel was built with them but does not bring them along
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), "cmeel-eigen"]
        subprocess.run(pip, check=True, capture_output=True)
        eigen = folder / "cmeel.prefix" / "include" / "eigen3"
    source, library = folder / "loops.cpp", folder / "loops.so"
    source.write_text(text)
    defines = [
        "PINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION",
        "BOOST_MPL_LIMIT_LIST_SIZE=30",
        "BOOST_FUSION_INVOKE_MAX_ARITY=10",
    ]
    includes = [prefix / "include", eigen, sysconfig.get_paths()["include"]]
    command = [
        "g++",
        "-std=c++17",
        "-O3",
        "-march=native",
        "-DEIGEN_MAX_ALIGN_BYTES=16",
        "-DNDEBUG",
        "-shared",
        "-fPIC",
        "-w",
    ]
    command += [f"-D{define}" for define in (*defines, "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS")]
    command += [f"-I{include}" for include in includes]
    command += [str(source), "-o", str(library), f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}"]
    command += ["-lpinocchio_default", f"-lboost_python{sys.version_info.major}{sys.version_info.minor}"]
    subprocess.run(command, check=True, capture_output=True)
    return ctypes.PyDLL(str(library))


def _eigen_folders(prefix: Path) -> tuple[str, ...]:
    return str(prefix / "include" / "eigen3"), "/usr/include/eigen3", "/usr/local/include/eigen3"


def in_turn(*functions: Callable[[], object], repetitions: int = REPETITIONS) -> list[float]:
    """Median CPU seconds of each function, called one after the other so that all meet the same machine."""
    times: list[list[float]] = [[] for _ in functions]
    for repetition in range(repetitions + 5):
        for function, taken in zip(functions, times, strict=True):
            start = time.process_time()
            function()
            if repetition >= 5:
                taken.append(time.process_time() - start)
    return [statistics.median(taken) for taken in times]


def compiled_loops(states: States, folder: Path) -> tuple[list[Callable[[], object]], Callable[[], object]]:
    """C++ loops for mass matrix and bias (two conventions), and for forward dynamics, checked against ours."""
    library, robot = compiled(folder), states.robot
    count, n = states.q.shape
    M, b, a = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros((count, n))
    handles = ctypes.py_object(states.model), ctypes.py_object(states.data), count
    # data_as, unlike the address alone, keeps the array alive
    q, v, tau, *out = (x.ctypes.data_as(ctypes.c_void_p) for x in (states.q, states.v, states.tau, M, b, a))

    def mass_and_bias(world: int) -> Callable[[], object]:
        return lambda: library.mass_and_bias(*handles, world, q, v, *out[:2])

    def forward() -> object:
        return library.forward_dynamics(*handles, q, v, tau, out[2])

    mass, bias = robot.mass_matrix_and_bias(*states.tensors[:2])
    for world in (0, 1):
        mass_and_bias(world)()
        np.testing.assert_allclose(np.tril(M), np.tril(mass), rtol=1e-9, atol=1e-9)  # column-major: theirs is the upper
        np.testing.assert_allclose(b, bias, rtol=1e-9, atol=1e-9)
    forward()
    np.testing.assert_allclose(a, robot.forward_dynamics(*states.tensors), rtol=1e-9, atol=1e-9)
    return [mass_and_bias(0), mass_and_bias(1)], forward


def run() -> dict[str, float]:
    """Measure and print; the ratio at batch 1000 (only to a C++ loop), and the ms of a single forward dynamics."""
    command = [sys.executable, "-m", "benchmarks.rigid_body", "fresh"]
    fresh = subprocess.run(command, check=True, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    torch.empty(30 * 2**20, dtype=torch.uint8)  # freed at once: see above
    states = States(BATCH)
    robot, (q, v, tau) = states.robot, states.tensors

    def ours() -> object:
        return robot.mass_matrix_and_bias(q, v)

    def our_forward() -> object:
        return robot.forward_dynamics(q, v, tau)

    aba = pinocchio = None
    with tempfile.TemporaryDirectory() as folder:
        try:
            theirs, their_forward = compiled_loops(states, Path(folder))
            mine, local, world = in_turn(ours, *theirs)
            mine_forward, aba = in_turn(our_forward, their_forward)
            pinocchio = min(local, world)
        except (OSError, subprocess.CalledProcessError) as error:
            why = getattr(error, "stderr", None)
            print(f"no C++ loop ({error}); {why.decode()[-500:] if why else ''}")
            mine, mine_forward = in_turn(ours, our_forward)

    one = q[0], v[0], tau[0]
    single, single_mass = in_turn(lambda: robot.forward_dynamics(*one), lambda: robot.mass_matrix_and_bias(*one[:2]))
    print(f"\n{'CPU ms, medians':52s}{'forcegp':>10s}{'C++ loop':>28s}{'ratio':>8s}")
    rows = [
        (f"mass matrix + bias, {BATCH} states", mine, pinocchio),
        (f"forward dynamics, {BATCH} states", mine_forward, aba),
        ("mass matrix + bias, 1 state", single_mass, None),
        ("forward dynamics, 1 state", single, None),
        (f"mass matrix + bias, {BATCH} states, in a fresh process", float(fresh.stdout), None),
    ]
    for label, forcegp, other in rows:
        compared = f"{1e3 * other:28.3f}{forcegp / other:8.2f}" if other else ""
        print(f"{label:52s}{1e3 * forcegp:10.3f}{compared}")
    measured = {"forward_dynamics_single_ms": 1e3 * single}
    if pinocchio is None:
        return measured
    return {"mass_bias_vs_pinocchio_b1000": mine / pinocchio} | measured


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    if arguments == ["fresh"]:
        states = States(BATCH)
        print(in_turn(lambda: states.robot.mass_matrix_and_bias(*states.tensors[:2]))[0])
        return
    with threadpool_limits(1):
        for key, value in run().items():
            print(f"{key}: {value:.3g}")


if __name__ == "__main__":
    main(sys.argv[1:])
