"""A fitted model as C99 that needs nothing but <math.h>, compiled and compared with `predict` before it appears."""

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

from forcegp.atomic_files import atomic_folder, require_replaceable, require_writable
from forcegp.codegen.library import compile_library, compiler
from forcegp.errors import CompilerError, InvalidInput, NumericalError, require_type
from forcegp.inference.posterior import ExactPosterior
from forcegp.posterior.c_files import CFiles, Check, identifier, split
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.preparation import rows_for, sample_states
from forcegp.posterior.programs import Physics, require_step

STATES = 300  # states at which the program is compared
MEAN_TOLERANCE = 5e-12  # largest difference relative to the largest value, unless `rounding` is larger
LOOSER = {"covariance": 1e3, "linearize": 1e2, "step": 1e3, "step_jacobian": 1e3, "deviations": 1e3}
LOOSER |= {"components": 10.0, "inverse_dynamics": 1e2}
"""How many times as much as the mean these may differ: more cancels in them."""
BETWEEN = ("linearize", "step", "step_jacobian", "inverse_dynamics")
SUFFIXES = {"covariance": "mean_covariance", "components": "forces", "deviations": "forces_deviation"}


@dataclass(frozen=True)
class CExport:
    """What `export_c` wrote: bytes by file, and the relative difference of each function from `predict`."""

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
    monitor: Any = None,
    unchecked: bool = False,
) -> CExport:
    """Write the model as C99 to a new folder: NAME.c, NAME.h, NAME.hpp, an example, a self-test, CMake.

    NAME_mean, NAME_forces, each force by itself, and of a base that is fixed NAME_inverse_dynamics are always there.
    `covariance` adds NAME_mean_covariance (the compressed one) and NAME_forces_deviation, `jacobian` NAME_linearize,
    `steps` NAME_step of so many seconds by the `integrator` ("symplectic-euler", "rk4", "implicit-midpoint") and its
    Jacobian, `monitor`, a calibrated `ContactMonitor` of the posterior's predictor, NAME_monitor_step; a base that
    moves adds NAME_integrate, and derivatives in a step from q, friction that remembers NAME_remember. `name` of files
    and functions is by default the robot's, `source` the model's origin in the header; `unchecked` compiles nothing.

    Raises InvalidInput for what cannot be exported, FileFormatError for a folder that has files, CompilerError where
    the compiler fails, NumericalError where the program and `predict` differ, OSError.
    """
    require_type("posterior", posterior, Posterior)
    posterior = posterior.to("cpu") if posterior.training.q.device.type != "cpu" else posterior
    if steps is not None:
        require_step(steps, integrator, posterior.model)
        if jacobian and len({*posterior.model.sizes}) > 1:
            seen = "derivatives of exported steps need a base that is fixed and one input per joint"
            raise InvalidInput(f"{seen}; export `jacobian` without `steps`, or take `predictor.linearize_step`.")
    if covariance and not (isinstance(posterior.latent, ExactPosterior) and posterior.latent_names):
        why = "it has no unknown forces, or its engine does not keep the factor of all rows"
        raise InvalidInput(f"this model has no covariance that could be exported: {why}; export without `covariance`.")
    folder = Path(folder)
    require_replaceable(folder, "export_c", lambda _: False, overwrite=False)
    require_writable(folder)
    reference = posterior.predictor(covariance="compressed" if covariance else "none", compile=False)
    code, called = posterior.programs(compressed=reference.compressed), identifier(name or posterior.model.robot.name)
    if monitor is not None:
        known: Any = getattr(monitor, "calibrated", None) and monitor.model
        same = known is posterior.model or getattr(known, "posterior", None) is posterior
        kind = known.kind if same and monitor.open and posterior.latent_names else "none"
        if not same or kind != ("compressed" if reference.kind == "compressed" else "none"):
            seen = "the monitor is that of another model, or counts another covariance than the program has"
            own = "posterior.predictor() and export with `covariance`"
            raise InvalidInput(f"{seen}; make it of {own}, or of posterior.predictor(covariance='none') without.")
    export = CFiles(posterior, reference, code, called, jacobian, steps, integrator, monitor)
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
    tolerance, found = max(MEAN_TOLERANCE, rounding(own, *sampled[finite].split(sizes, dim=-1))), []
    for kind in export.kinds:
        states = between if kind in BETWEEN else sampled[finite]
        (q, v, u), given = states.split(sizes, dim=-1), sizes
        match kind:
            case "inverse_dynamics":  # forward dynamics turned round
                predicted, column = own.predict(q, v, u, covariance=False), own.model.memory_column
                z = u[:, column : column + len(own.model.memory.names)]
                wanted = [torch.cat([u[:, :column], u[:, column + z.shape[1] :]], dim=1)]
                pressed = q[:, :0] if predicted.multiplier is None else predicted.multiplier.mean
                states = torch.cat(beside := [q, v, predicted.mean, pressed, z], dim=1)
                given = [x.shape[1] for x in beside]
            case "components" | "deviations":
                wanted = _parts(export, q, v, u)[: 1 + (kind == "deviations")]
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
        found.append(Check(function, tuple(given), states.numpy(), values, tolerance * LOOSER.get(kind, 1.0), set()))
    return found


def _parts(export: CFiles, q: Tensor, v: Tensor, u: Tensor) -> list[Tensor]:
    """Joint forces (n, P, nv) of the passive laws and unknown forces, and standard deviations by torch."""
    own, compressed, physics = export.posterior, export.reference.compressed, export.code.physics
    with torch.no_grad():
        dynamics = own.dynamics(q, v, u)
        B = own.trained.unknown.direction(dynamics)
        parts = physics.parts(dynamics, B, own.latents(dynamics, False).mean)
        deviations = torch.zeros_like(parts)
        if compressed is not None:
            S = own.widening**2 * compressed.at(own.latent, physics.mixing(q, v, u)[1])
            for k, which in enumerate(physics.terms.values(), len(physics.passive)):
                own_B = B[..., which]
                deviations[:, k] = ((own_B @ S[:, which, which]) * own_B).sum(-1).clamp_min(0.0).sqrt()
    return [parts, deviations]


def _compared(export: CFiles, checks: Sequence[Check], folder: Path) -> dict[str, float]:
    """The largest difference by function. Nothing without a compiler; a warning says so."""
    try:
        compiler()
    except CompilerError as error:
        warnings.warn(f"the exported program was not compared with forcegp: {error}", stacklevel=3)
        return {}
    options = ("-std=c99", "-O1", "-fPIC", "-shared", "-I", str(folder))
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "checked.so"
        library = compile_library(f'#include "{export.name}.c"\n', options, path, f"{export.name}_mean")
        found = {check.function: _difference(export, library[check.function], check) for check in checks}
        bounds = {check.function: check.tolerance for check in checks}
        if export.monitor is not None:
            found |= (apart := _monitored(export, library, checks[0].states[: STATES // 3]))
            bounds |= dict.fromkeys(apart, LOOSER["covariance"] * checks[0].tolerance)
        for name, worst in found.items():
            if not worst <= bounds[name]:
                seen = f"{name} of the compiled program and forcegp differ by {worst:.2g} of the largest value"
                doubt = "look at the model: its kernel matrix may be near singular"
                advice = f"name another compiler by the environment variable CC, or {doubt}."
                raise NumericalError(f"{seen}, more than {bounds[name]:.2g}, so nothing was written; {advice}")
    return found


def _monitored(export: CFiles, library: Any, states: np.ndarray) -> dict[str, float]:
    """The largest relative differences of the monitor's functions along these states."""
    step, place = (f"{export.name}_monitor_{what}" for what in ("step", "place"))
    column, count = export.posterior.model.memory_column, len(export.posterior.model.memory.names)
    monitor, rows, links = export.monitor, [], [*export.monitor.ends]
    state = np.zeros(10 * states.shape[1] + 10)
    monitor.restart()
    for row in states:
        q, v, u = (x.copy() for x in split(row, export.code.sizes))
        u = np.delete(u, np.arange(column, column + count))
        torque, distance, alarm, place_c = (np.zeros(size) for size in (len(v), 1, 1, 10 + len(links)))
        library[step](*(ctypes.c_void_p(x.ctypes.data) for x in (state, q, v, u, torque, distance, alarm)))
        library[place](*(ctypes.c_void_p(x.ctypes.data) for x in (q, torque, place_c)))
        seen, at = monitor(q, v, u), monitor.place(q, torque)
        found = torque, distance, *place_c[:9].reshape(3, 3), place_c[9:].view(np.int32)[: 1 + len(links)]
        also = [links.index(at.link), *(name in at.also for name in links)]
        rows.append((found, (seen.torque, seen.distance[None], at.point, at.force, at.force_std, also)))
    monitor.restart()
    made, wanted = ([np.array(x) for x in zip(*each, strict=True)] for each in zip(*rows, strict=True))
    apart = [np.abs(x - y).max() / max(np.abs(y).max(), 1e-300) for x, y in zip(made, wanted, strict=True)]
    return {step: float(max(apart[:2])), place: float(max(apart[2:]))}


def _difference(export: CFiles, function: Any, check: Check) -> float:
    """The largest one; without a few states outside of a table, or where an implicit step has two solutions."""
    worst = 0.0
    for row, state in enumerate(check.states):
        made = [np.full(x.shape[1], np.nan) for x in check.wanted]
        bits = function(*(ctypes.c_void_p(x.ctypes.data) for x in (*split(state, check.sizes), *made)))
        pairs = zip(made, check.wanted, check.scales, strict=True)
        apart = float(np.max([np.abs(x - wanted[row]).max() / scale for x, wanted, scale in pairs]))
        if bits or (not apart <= check.tolerance and _solved(export, check, state, made)):
            check.left_out.add(row)
        else:
            worst = float(np.maximum(worst, apart))
    return worst if 2 * len(check.left_out) < len(check.states) else np.inf


def _solved(export: CFiles, check: Check, state: np.ndarray, made: list[np.ndarray]) -> bool:
    """Whether an implicit step, or a u, is a solution, though another one than torch finds."""
    given = [torch.tensor(x) for x in split(state, check.sizes)]
    if check.function.endswith("_inverse_dynamics") and np.isfinite(made[0]).all():
        q, v, a, _, z = given
        u, column = torch.tensor(made[0]), export.posterior.model.memory_column
        again = export.posterior.predict(q, v, torch.cat([u[:column], z, u[column:]]), covariance=False).mean
        return float((again - a).norm()) <= 1e-9 * (1.0 + float(a.norm()))
    if export.integrator != "implicit-midpoint" or "_step" not in check.function or export.dt is None:
        return False
    q, v, u = given
    m = 0.5 * (v + torch.tensor(made[1]))
    if not bool(m.isfinite().all()):
        return False
    a = export.posterior.predict(q + 0.5 * export.dt * m, m, u, covariance=False).mean
    return float((m - v - 0.5 * export.dt * a).norm()) <= 1e-9 * (1.0 + float(m.norm()))
