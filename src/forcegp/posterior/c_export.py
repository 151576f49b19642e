"""A fitted model as C99 that needs nothing but <math.h>, compiled and compared with `predict` before it appears."""

import ctypes
import importlib.metadata
import re
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.atomic_files import atomic_folder, require_replaceable, require_writable
from forcegp.codegen.c_writer import c_text, filled, head, sections, write_function
from forcegp.codegen.library import compile_library, compiler
from forcegp.data import units_for
from forcegp.errors import CompilerError, InvalidInput, NumericalError, require_type
from forcegp.inference.posterior import ExactPosterior
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import require_actuated
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.preparation import rows_for, sample_states
from forcegp.posterior.programs import WITH_SLOPES, Physics, Programs, require_step

STORED = 10
"""States of the self-test."""
ALIKE = ("CMakeLists.txt", "example.c", "self_test.c", "README.txt")
TAKEN = ("math", "string", "stdio", "stddef", "stdarg", "features", "example", "self_test", "jac", "hess", "null")
"""Names of other files, and those that CasADi does not take."""


def identifier(name: str) -> str:
    """A name for C and for files, of any text."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name)[:60].strip("_").lower() or "robot"
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    return f"{plain}_model" if plain in TAKEN else plain


@dataclass(frozen=True)
class Check:
    """What a function of the program gives at states (n, ...), and how far it may be from that, relative.

    `sizes` are those of its arguments, q, v and u for most, which stand beside each other in a row of `states`.
    """

    function: str
    sizes: tuple[int, ...]
    states: np.ndarray
    wanted: list[np.ndarray]
    tolerance: float
    left_out: set[int]
    """Rows that the self-test does not hold."""

    @property
    def scales(self) -> list[float]:
        """The largest value of every output."""
        return [float(np.abs(x).max()) or 1.0 for x in self.wanted]


@dataclass(frozen=True, eq=False)
class CFiles:
    """The texts of all files of a program; `reference` computes by torch what it does."""

    posterior: Posterior
    reference: Predictor
    code: Programs
    name: str
    jacobian: bool
    dt: float | None
    integrator: str

    @property
    def kinds(self) -> list[str]:
        """The functions of the program."""
        chosen = {"covariance": self.reference.kind == "compressed", "linearize": self.jacobian}
        chosen |= {"step": self.dt is not None, "step_jacobian": self.dt is not None and self.jacobian}
        parts = len(self.code.physics.names)
        chosen |= {"inverse_dynamics": self.solvable, "components": parts > 0}
        chosen["deviations"] = chosen["covariance"] and parts > 0
        return ["mean", *(kind for kind, wanted in chosen.items() if wanted)]

    @property
    def solvable(self) -> bool:
        """Whether a u is wanted for every acceleration."""
        try:
            require_actuated(self.posterior)
        except InvalidInput:
            return False
        return True

    def write(self, folder: Path, source: str | None, said: str, checks: Sequence[Check]) -> None:
        """All files; `said` is how good the program is."""
        nq, nv, nu = self.code.sizes
        start = [", ".join(map(repr, x.tolist())) for x in _split(checks[0].states[0], self.code.sizes)]
        program = sections(__name__, "exported_c/model.c")
        space = self.code.space
        stepped = "" if self.dt is None else self.code.step_source(self.integrator, self._stepped)
        words: dict[str, object] = {"NAME": self.name, "NV": nv, "NQ": nq, "NU": nu, "DT": self.dt}
        words |= dict(zip(("START_Q", "START_V", "START_U"), start, strict=True))
        words |= dict(zip(("STORED", "CALLS"), self._stored(checks), strict=True))
        words |= {"STEP": stepped, "SLOPES": program[self.integrator], "CHECKED": said}
        words |= {
            "COMMENT": self._comment(said),
            "GIVEN": 0,
            "GIVEN_PARTS": 0,
            "IMPLICIT": int(self.integrator == "implicit-midpoint"),
        }
        words |= {"SOURCE": _plain(source or "not named"), "VERSION": importlib.metadata.version("forcegp")}
        moving = not space.is_vector_space
        words |= {"ALL": nq + nv + nu, "X": nq + nv, "COLUMNS": 2 * nv + nu, "TITLE": self._title}
        words["STATE"] = "step from q, v, u" if moving else "q, v, u"
        words["ADVANCE"] = sections(__name__, "exported_c/advance.c")["turned" if moving else "added"]
        if "covariance" in self.kinds:
            words["GIVEN"] = len(self.code.program("covariance").nodes)
            words["GIVEN_PARTS"] = len(self.code.program("deviations").outputs["covariance"])
        words = {word: filled(str(value), words) for word, value in words.items()}
        memory = self.posterior.model.memory.names
        physics = self.code.physics
        words |= {"MEMORY": len(memory), "COLUMN": self.posterior.model.memory_column, "PARTS": len(physics.names)}
        words |= {"CONTACTS": len(self.posterior.model.contacts), "TERMS": len(physics.terms)}
        words |= {"LAWS": len(physics.passive), "NAMED": ", ".join(map(_plain, physics.names))}
        words["AFFINE"] = int(self.solvable and self.code.affine)
        kinds = (*(("integrate",) if moving else ()), *(("remember",) if memory else ()), *self.kinds)
        functions = filled("".join(program[kind] for kind in kinds), words)
        prototypes = re.findall(r"^(/\*[^{}]*?\*/\nint [^{]*?) {", functions, re.MULTILINE)
        words["PROTOTYPES"] = "\n".join(f"{found};" for found in prototypes)
        parts = [filled(program["head"], words), *self._program(), filled(program["calls"], words), functions]
        files = {
            f"{self.name}.c": "\n".join(parts),
            f"{self.name}.h": filled(c_text(__name__, "exported_c/model.h"), words),
        }
        for form in ("external", "acados") if self.dt is not None else ("external",):
            found = sections(__name__, f"exported_c/{form}.c")
            usable = [kind for kind in self.kinds if kind != "linearize" or nq == nv == nu]  # of one size
            chosen = "".join(found[kind] for kind in ("head", *usable) if kind in found)
            files[f"{self.name}_{form}.c"] = filled(chosen, words)
        files |= {file: filled(c_text(__name__, f"exported_c/{file}"), words) for file in ALIKE}
        for file, content in files.items():
            (folder / file).write_text(content, encoding="ascii")

    @property
    def _stepped(self) -> str:
        return "slopes" if self.integrator == "implicit-midpoint" else "mean"

    def _program(self) -> Iterator[str]:
        """Tables and static functions."""
        names, code = [], self.code
        wanted = {"covariance": "mean_and_terms"} if "covariance" in self.kinds else {}
        slopes = self.jacobian or (self.dt is not None and self._stepped == "slopes")
        wanted |= {"mean": "mean"} | ({"linearize": "slopes"} if slopes else {})
        wanted |= {kind: kind for kind in ("components", "deviations") if kind in self.kinds}
        wanted |= {"forces": "forces_at"} if self.solvable else {}
        yield head(1)
        for k, table in enumerate(code.tables("covariance" if "covariance" in wanted else "mean")):
            names.append(f"table{k}")
            yield f"static const double table{k}[] = {{\n{_numbers(table.tolist())}}};"
        yield f"static const double *const tables[] = {{{', '.join(names) or '0'}}};"
        for kind in (False, True) if WITH_SLOPES & wanted.keys() else (False,):
            yield from (part.c_source(1, kind) for part in code.sums)
        if "covariance" in wanted:
            yield from (part.roots_source(1, code.rank) for part in code.sums)
            yield code.covariance_source("covariance_of")
            yield code.covariance_source("covariance_of_parts", len(code.physics.terms) * code.sizes[1])
        yield from code.motion_source(1)
        yield from code.memory_source(1)
        for kind, function in wanted.items():
            program = code.program(kind)
            called = [part.name + ("_slopes" if kind in WITH_SLOPES else "") for part in code.sums]
            yield write_function(function, program.graph, program.nodes, 1, called)

    @property
    def _title(self) -> str:
        points = f"{len(self.posterior.training.q)} training points"
        return _plain(f"(q, v, u) -> a of {self.posterior.model.robot.name}, {self.posterior.description}, {points}")

    def _comment(self, said: str) -> str:
        robot, units = self.posterior.model.robot, units_for(self.posterior.model.robot)
        lines = [self._title, f"contacts: {len(self.posterior.model.contacts)}"]
        if not self.code.space.is_vector_space:
            lines += [f"q: {', '.join(robot.position_names)}; any length of a quaternion or of cos and sin serves"]
            lines += [f"v, a: {', '.join(robot.joint_names)}; of a base in its own axes; m, rad, s"]
            lines += [f"u: {', '.join(self.posterior.model.inputs)}, in the units of the model; switches are 1 or 0"]
        for k, name in enumerate(robot.joint_names if self.code.space.is_vector_space else ()):
            own = (f"{key} in {units[key] if isinstance(units[key], str) else units[key][k]}" for key in "qvua")
            lines.append(f"joint {k}: {name}, {', '.join(own)}")
        if memory := self.posterior.model.memory.names:
            column = self.posterior.model.memory_column
            lines.append(f"u[{column}] and on: {', '.join(memory)}, which {self.name}_remember carries along")
        if self.reference.inflation is not None:
            wider = float(self.reference.inflation.max())
            lines.append(f"standard deviations: never below those of predict, at most {wider:.1%} above at its checks")
        lines += [f"a step lasts {self.dt!r} s, by {self.integrator}"] if self.dt is not None else []
        return "\n".join(f"   {_plain(line)}" for line in [*lines, said])

    def _stored(self, checks: Sequence[Check]) -> tuple[str, str]:
        """Arrays and calls of the self-test."""
        arrays, calls = [], []
        for check in checks:
            rows = [k for k in range(min(len(check.states), 100)) if k not in check.left_out]
            rows = rows[:: max(1, len(rows) // STORED)]
            states, what = check.states[rows], check.function.removeprefix(f"{self.name}_")
            arrays.append(_array(f"{what}_states", states))
            given = [f"{what}_states[k] + {place}" for place in np.cumsum([0, *check.sizes[:-1]])]
            made = [f"r{j}" for j in range(len(check.wanted))]
            lines = [f"double {r}[{wanted.shape[1]}];" for r, wanted in zip(made, check.wanted, strict=True)]
            lines.append(f"if ({check.function}({', '.join(given + made)})) failures++;")
            for j, (wanted, scale) in enumerate(zip(check.wanted, check.scales, strict=True)):
                arrays.append(_array(f"{what}_{j}", wanted[rows]))
                bound = 10.0 * check.tolerance * scale
                lines.append(f'compare("{check.function}", r{j}, {what}_{j}[k], {wanted.shape[1]}, {bound!r});')
            calls.append(f"  for (int k = 0; k < {len(states)}; k++) {{\n    " + "\n    ".join(lines) + "\n  }")
        return "\n".join(arrays), "\n".join(calls)


def _split(rows: np.ndarray, sizes: Sequence[int]) -> list[np.ndarray]:
    """What stands beside each other in rows (..., size)."""
    return np.split(rows, np.cumsum(sizes)[:-1], axis=-1)


def _numbers(values: Sequence[float]) -> str:
    lines = (values[k : k + 6] for k in range(0, len(values), 6))
    return "".join(f"  {', '.join(value.hex() for value in line)},\n" for line in lines)


def _array(name: str, rows: np.ndarray) -> str:
    text = ",\n  ".join(f"{{{', '.join(value.hex() for value in row)}}}" for row in rows.tolist())
    return f"static const double {name}[{len(rows)}][{rows.shape[1]}] = {{\n  {text}}};"


def _plain(line: str) -> str:
    """Text that cannot end a comment, whatever a robot file calls its joints."""
    return re.sub(r"[^\x20-\x7e]|[@*?\\]", "_", line)


STATES = 300
"""States at which the program is compared."""
MEAN_TOLERANCE = 5e-12
"""Largest difference relative to the largest value, unless `rounding` is larger."""
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
    unchecked: bool = False,
) -> CExport:
    """Write the model as C99 to a new folder: NAME.c, NAME.h, an example, a self-test, CMake, forms for CasADi, acados.

    `covariance` adds NAME_mean_covariance (the compressed one), `jacobian` NAME_linearize, `steps` NAME_step of so many
    seconds by the `integrator` ("symplectic-euler", "rk4", "implicit-midpoint") and its Jacobian; a base that moves
    adds NAME_integrate, and derivatives in a step from q, friction that remembers NAME_remember. `name` of files and
    functions is by default the robot's, `source` what the header names as the model's origin; `unchecked` neither
    compiles nor compares.

    Raises InvalidInput for what cannot be exported, FileFormatError for a folder that has files, CompilerError where
    the compiler fails, NumericalError where the program and `predict` differ, OSError.
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
    require_replaceable(folder, "export_c", lambda _: False, overwrite=False)
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
    tolerance = max(MEAN_TOLERANCE, lost)
    found = []
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
        bits = function(*(ctypes.c_void_p(x.ctypes.data) for x in (*_split(state, check.sizes), *made)))
        pairs = zip(made, check.wanted, check.scales, strict=True)
        apart = float(np.max([np.abs(x - wanted[row]).max() / scale for x, wanted, scale in pairs]))
        if bits or (not apart <= check.tolerance and _solved(export, check, state, made)):
            check.left_out.add(row)
        else:
            worst = float(np.maximum(worst, apart))
    return worst if 2 * len(check.left_out) < len(check.states) else np.inf


def _solved(export: CFiles, check: Check, state: np.ndarray, made: list[np.ndarray]) -> bool:
    """Whether an implicit step, or a u, is a solution, though another one than torch finds."""
    given = [torch.tensor(x) for x in _split(state, check.sizes)]
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
