"""A fitted model as C99 that needs nothing but <math.h>: `export_c`.

The program is that of a compiled predictor (`programs`) for one state, with its tables inside as constants; what
is written (`c_files`) is compiled and compared with `posterior.predict` before the folder appears.
"""

import ctypes
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.atomic_files import atomic_folder, require_writable
from forcegp.codegen.library import compile_library, compiler
from forcegp.errors import CompilerError, InvalidInput, NumericalError, require_type
from forcegp.inference.posterior import ExactPosterior
from forcegp.posterior.c_files import CFiles, Check, identifier
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.preparation import rows_for, sample_states
from forcegp.posterior.programs import Physics, require_step

STATES = 300
"""States at which the program is compared."""
MEAN_TOLERANCE, TABLE_TOLERANCE = 5e-12, 1e-7
"""Largest difference relative to the largest value: of sums, unless `Predictor.rounding` is larger, and of tables."""
LOOSER = {"covariance": 1e3, "linearize": 1e2, "step": 1e3, "step_jacobian": 1e3}
"""How many times as much as the mean these may differ: more cancels in them."""
BETWEEN = ("linearize", "step", "step_jacobian")
SUFFIXES = {"covariance": "mean_covariance"}


@dataclass(frozen=True)
class CExport:
    """What `export_c` wrote: bytes by file, and how far each function is from `predict`, relative to the largest value.

    `differences` is empty where nothing was compared. `inflation` is how much wider standard deviations are at most.
    """

    name: str
    folder: Path
    files: dict[str, int]
    differences: dict[str, float]
    inflation: float | None


def export_c(
    posterior: Posterior,
    folder: str | Path,
    *,
    covariance: bool = False,
    jacobian: bool = False,
    steps: float | None = None,
    integrator: str = "symplectic-euler",
    name: str | None = None,
    source: str | None = None,
    unchecked: bool = False,
) -> CExport:
    """Write the model as C99 to a new folder: NAME.c, NAME.h, an example, a self-test, CMake, forms for CasADi, acados.

    Parameters
    ----------
    covariance: with NAME_mean_covariance, whose covariance is the compressed one of `posterior.predictor()`.
    jacobian: with NAME_linearize, and NAME_step_jacobian if there are steps.
    steps: with NAME_step, a step of so many seconds by the `integrator`, "symplectic-euler", "rk4" or
        "implicit-midpoint".
    name: of files and functions, made a C identifier; None: that of the robot.
    source: what the header names as the model's origin.
    unchecked: do not compile and compare.

    A robot whose base moves has NAME_integrate, too, and derivatives in a step from q.

    Raises InvalidInput for another kind of model, measured torques, a prior that cannot be exported, a covariance where
    the engine has none to compress, steps that are no positive number, another integrator, and a folder that has files;
    CompilerError where the compiler fails, NumericalError where the program and `predict` differ, OSError.
    """
    require_type("posterior", posterior, Posterior)
    posterior = posterior.to("cpu") if posterior.training.q.device.type != "cpu" else posterior
    if steps is not None:
        require_step(steps, integrator, posterior.model)
        if jacobian and len({*posterior.model.sizes}) > 1:
            raise InvalidInput(
                "derivatives of exported steps need a base that is fixed and one input per joint; export `jacobian` "
                "without `steps`, or take `predictor.linearize_step`."
            )
    if covariance and not (isinstance(posterior.latent, ExactPosterior) and posterior.latent_names):
        raise InvalidInput(
            "this model has no covariance that could be exported: it has no unknown forces, or its engine does not "
            "keep the factor of all rows; export without `covariance`."
        )
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InvalidInput(f"{folder} exists already and is not an empty folder; choose another name.")
    require_writable(folder)
    reference = posterior.predictor(covariance="compressed" if covariance else "none", compile=False)
    code = posterior.programs(compressed=reference.compressed)
    called = identifier(name or posterior.model.robot.name)
    export = CFiles(posterior, reference, code, called, jacobian, steps, integrator)
    checks = _checks(export)
    with atomic_folder(folder, overwrite=False) as temporary:
        temporary.mkdir()
        export.write(temporary, source, "", checks)
        differences = {} if unchecked else _compared(export, checks, temporary)
        apart = ", ".join(f"{what} {value:.1e}" for what, value in differences.items())
        states = f"at {STATES} states, training rows and others between and around them"
        said = f"Compared with forcegp {states}; largest difference / largest value: {apart}."
        said = said if apart else "This program was not compared with forcegp: run self_test.c."
        export.write(temporary, source, said, checks)
        files = {path.name: path.stat().st_size for path in sorted(temporary.iterdir())}
    inflation = None if reference.inflation is None else float(reference.inflation.max())
    return CExport(export.name, folder, files, differences, inflation)


def rounding(posterior: Posterior, q: Tensor, v: Tensor, u: Tensor) -> float:
    """What rounding of the sums over all points may change in the mean, relative to its largest value there."""
    physics, latent = Physics.of(posterior, posterior.model), posterior.latent
    W, features = physics.mixing(q, v, u)
    if not W.shape[-1]:
        return 0.0
    mean = posterior.predict(q, v, u, covariance=False).mean
    parts = zip(latent.kernels.dense, features, latent.features, latent.weights, strict=True)
    terms = torch.stack([kernel.cross(z, centers).abs() @ w.abs() for kernel, z, centers, w in parts], dim=-1)
    return torch.finfo(mean.dtype).eps * float((W.abs() @ terms[..., None]).max() / mean.abs().max())


def _checks(export: CFiles) -> list[Check]:
    """Every function at states; derivatives, which may jump at training rows, and steps between these only."""
    own, made = export.posterior, export.reference
    training = rows_for(own.training, own.trained, own.model)
    space, sizes = export.code.space, list(export.code.sizes)
    sampled = torch.cat(sample_states(training, space, STATES, 0, STATES // 3), dim=-1)
    finite = export.posterior.predict(*sampled.split(sizes, dim=-1), covariance=False).mean.isfinite().all(-1)
    rows = min(STATES // 3, len(training.q))  # of the data themselves; then as many moved ones
    away = torch.randn(len(sampled), 1, generator=torch.Generator().manual_seed(0)).double()
    moved = sampled + 1e-3 * sampled.std(0).clamp_min(1e-3) * away  # as some of these are by nothing
    if not space.is_vector_space:
        moved[:, : sizes[0]] = space.normalized(moved[:, : sizes[0]])
    between = moved[rows : 2 * rows][finite[rows : 2 * rows]][:: 1 + rows // 33]
    lost = rounding(own, *sampled[finite].split(sizes, dim=-1))
    tolerance = TABLE_TOLERANCE if export.table_error else max(MEAN_TOLERANCE, lost)
    found = []
    for kind in export.kinds:
        states = between if kind in BETWEEN else sampled[finite]
        q, v, u = states.split(sizes, dim=-1)
        match kind:
            case "mean":
                wanted = [export.posterior.predict(q, v, u, covariance=False).mean]
            case "covariance":
                wanted = list(made(q, v, u))
            case "linearize":
                a, *slopes = made.linearize(q, v, u)
                wanted = [a, torch.cat(slopes, dim=-1)]
            case "step":
                wanted = list(made.step(q, v, u, export.dt or 0.0, export.integrator))
            case _:
                wanted = list(made.linearize_step(q, v, u, export.dt or 0.0, export.integrator)[:4])
        values = [x.detach().flatten(1).numpy() for x in wanted]
        function = f"{export.name}_{SUFFIXES.get(kind, kind)}"
        found.append(Check(function, states.numpy(), values, tolerance * LOOSER.get(kind, 1.0), set()))
    return found


def _compared(export: CFiles, checks: Sequence[Check], folder: Path) -> dict[str, float]:
    """The largest difference by function. Nothing without a compiler; a warning says so."""
    try:
        compiler()
    except CompilerError as error:
        warnings.warn(f"the exported program was not compared with forcegp: {error}", stacklevel=3)
        return {}
    options = ("-std=c99", "-O2", "-fPIC", "-shared", "-I", str(folder))
    found = {}
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "checked.so"
        library = compile_library(f'#include "{export.name}.c"\n', options, path, f"{export.name}_mean")
        for check in checks:
            found[check.function] = worst = _difference(export, library[check.function], check)
            if not worst <= check.tolerance:
                raise NumericalError(
                    f"{check.function} of the compiled program and forcegp differ by {worst:.2g} of the largest "
                    f"value, more than {check.tolerance:.2g}, so nothing was written; name another compiler by "
                    "the environment variable CC, or look at the model: its kernel matrix may be near singular."
                )
    return found


def _difference(export: CFiles, function: Any, check: Check) -> float:
    """The largest one; without a few states outside of a table, or where an implicit step has two solutions."""
    worst = 0.0
    for row, state in enumerate(check.states):
        made = [np.full(x.shape[1], np.nan) for x in check.wanted]
        bits = function(*(ctypes.c_void_p(x.ctypes.data) for x in (*export.split(state), *made)))
        pairs = zip(made, check.wanted, check.scales, strict=True)
        apart = float(np.max([np.abs(x - wanted[row]).max() / scale for x, wanted, scale in pairs]))
        if bits or (not apart <= check.tolerance and _solved(export, check, state, made)):
            check.left_out.add(row)
        else:
            worst = float(np.maximum(worst, apart))
    return worst if 2 * len(check.left_out) < len(check.states) else np.inf


def _solved(export: CFiles, check: Check, state: np.ndarray, made: list[np.ndarray]) -> bool:
    """Whether an implicit step ends at a solution, though at another one than torch finds."""
    if export.integrator != "implicit-midpoint" or "_step" not in check.function or export.dt is None:
        return False
    q, v, u = (torch.tensor(x) for x in export.split(state))
    m = 0.5 * (v + torch.tensor(made[1]))
    if not bool(m.isfinite().all()):
        return False
    a = export.posterior.predict(q + 0.5 * export.dt * m, m, u, covariance=False).mean
    return float((m - v - 0.5 * export.dt * a).norm()) <= 1e-9 * (1.0 + float(m.norm()))
