"""What do mass matrix, bias forces and forward dynamics cost, against Pinocchio in C++?

The Pinocchio side is a C++ loop over the batch (`crba`, in the faster of its two conventions, then `nonLinearEffects`,
or `aba`) on data allocated before, compiled with `g++ -O3 -march=native` against the installed library as this runs,
and called through ctypes: one process, one thread, both sides in turn, CPU seconds, medians. Both sides are first
checked to agree. The robot is the KUKA iiwa. The algorithms themselves are in that library, which is built for any
processor; instantiated with the loop instead, they took minutes to compile and ran 15-25 % faster.

Where it cannot be compiled (no g++, no Python or Eigen headers), there is no ratio.

glibc gives the memory of large tensors back to the system after each call until a process has freed a larger one, and
taking it again costs page faults. Any process that has fitted a model is past that, and this one is made so.

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
import torch
from threadpoolctl import threadpool_limits

from forcegp.robots import Robot
from forcegp.robots.compiled import CompiledRobot
from forcegp.simulation import kuka_file

BATCH, REPETITIONS = 1000, 200
URDF = kuka_file()

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


class Loops:
    """The C++ loops over given states; results in ``M``, ``bias`` and ``a``."""

    def __init__(self, states: States, folder: Path) -> None:
        library = compiled(folder)
        count, n = states.q.shape
        self.M, self.bias, self.a = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros((count, n))
        handles = ctypes.py_object(states.model), ctypes.py_object(states.data)
        given = states.q, states.v, states.tau, self.M, self.bias, self.a
        q, v, tau, M, bias, a = (x.ctypes.data_as(ctypes.c_void_p) for x in given)
        self.mass_and_bias: list[Callable[[], object]] = [
            lambda world=world: library.mass_and_bias(*handles, count, world, q, v, M, bias) for world in (0, 1)
        ]
        self.forward: Callable[[], object] = lambda: library.forward_dynamics(*handles, count, q, v, tau, a)


class Ours:
    """The same questions to a robot, compiled or not."""

    def __init__(self, states: States, of: Robot | CompiledRobot) -> None:
        self.of, self.states = of, states

    def mass_and_bias(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.of.mass_matrix_and_bias(*self.states.tensors[:2])

    def forward(self) -> torch.Tensor:
        return self.of.forward_dynamics(*self.states.tensors)


def largest_error(ours: torch.Tensor, theirs: np.ndarray | torch.Tensor) -> float:
    """Largest deviation in units of the largest value."""
    expected = torch.as_tensor(theirs)
    return float((ours - expected).abs().max() / expected.abs().max())


def agreement(mine: Ours, loops: Loops) -> float:
    """Largest error of all results."""
    mass, bias = mine.mass_and_bias()
    errors = []
    for loop in loops.mass_and_bias:
        loop()
        errors += [largest_error(mass.tril(), np.tril(loops.M)), largest_error(bias, loops.bias)]
    loops.forward()
    errors.append(largest_error(mine.forward(), loops.a))
    assert max(errors) < 1e-9, errors
    return max(errors)


def run() -> dict[str, float]:
    """Measure and print; the ratio at batch 1000 (only to a C++ loop), and the ms of a single forward dynamics."""
    torch.empty(30 * 2**20, dtype=torch.uint8)  # freed at once: see above
    states = States(BATCH)
    mine, one = Ours(states, states.robot), tuple(x[0] for x in states.tensors)
    with tempfile.TemporaryDirectory() as folder:
        try:
            loops = Loops(states, Path(folder))
            agreement(mine, loops)
            mass, *theirs = in_turn(mine.mass_and_bias, *loops.mass_and_bias)
            forward, aba = in_turn(mine.forward, loops.forward)
        except (OSError, subprocess.CalledProcessError) as error:
            why = getattr(error, "stderr", None)
            print(f"no C++ loop ({error}); {why.decode()[-500:] if why else ''}")
            (mass, forward), theirs, aba = in_turn(mine.mass_and_bias, mine.forward), [], None
    (single,) = in_turn(lambda: states.robot.forward_dynamics(*one))
    pinocchio = min(theirs, default=None)
    print(f"\n{'CPU ms, medians':52s}{'forcegp':>10s}{'C++ loop':>28s}{'ratio':>8s}")
    for label, forcegp, other in (
        (f"mass matrix + bias, {BATCH} states", mass, pinocchio),
        (f"forward dynamics, {BATCH} states", forward, aba),
        ("forward dynamics, 1 state", single, None),
    ):
        compared = f"{1e3 * other:28.3f}{forcegp / other:8.2f}" if other else ""
        print(f"{label:52s}{1e3 * forcegp:10.3f}{compared}")
    ratio = {} if pinocchio is None else {"mass_bias_vs_pinocchio_b1000": mass / pinocchio}
    return ratio | {"forward_dynamics_single_ms": 1e3 * single}


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        for key, value in run().items():
            print(f"{key}: {value:.3g}")
