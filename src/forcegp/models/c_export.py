"""A fitted model as C99 that needs nothing but <math.h>: `export_c`.

The program is that of a compiled predictor (`predictor_code`) for one state, with its tables inside as constants. What
is written is compiled and compared with `posterior.predict` before the folder appears.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import re
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.atomic_files import atomic_folder, require_writable
from forcegp.codegen.c_writer import head, write_function
from forcegp.codegen.native_code import Purpose, compile_library
from forcegp.codegen.tracing import trace
from forcegp.data import units_for
from forcegp.errors import CompilerError, InvalidInput, NumericalError
from forcegp.inference.one_input_calls import OneInputCall, latent_calls
from forcegp.inference.posterior import ExactPosterior
from forcegp.integration.integrators import check_time_step, integrator_named
from forcegp.models.fused_rollouts import STEPS
from forcegp.models.predictor import Predictor
from forcegp.models.predictor_code import PredictorCode
from forcegp.models.structured.components import term_slices
from forcegp.models.structured.posterior import StructuredPosterior
from forcegp.models.structured.predictor_preparation import sample_states

STATES, STORED = 300, 10
"""States at which the program is compared, and those of the self-test."""
MEAN_TOLERANCE, TABLE_TOLERANCE = (5e-12, 1e-11), 1e-7
"""Largest difference relative to the largest value: of sums over up to 100 and more points, and of tables."""
LOOSER = {"covariance": 1e3, "linearize": 1e2, "step": 1e3, "step_jacobian": 1e3}
"""How many times as much as the mean these may differ: more cancels in them."""
ALIKE = ("CMakeLists.txt", "example.c", "self_test.c", "README.txt")
BETWEEN = ("linearize", "step", "step_jacobian")
SUFFIXES = {"covariance": "mean_covariance"}
PURPOSE = Purpose(
    "the check of an exported model", "the environment variable TMPDIR", "export without it, `unchecked=True`"
)
TAKEN = ("math", "string", "stdio", "example", "self_test")
"""Names of other files."""


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
    posterior: StructuredPosterior,
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

    Raises InvalidInput for another kind of model, measured torques, a prior that cannot be exported, a covariance where
    the engine has none to compress, steps that are no positive number, another integrator, and a folder that has files;
    CompilerError where the compiler fails, NumericalError where the program and `predict` differ, OSError.
    """
    if not isinstance(posterior, StructuredPosterior):
        raise InvalidInput(
            f"a {type(posterior).__name__} cannot be exported as C; only models with rigid-body dynamics can: fit a "
            "StructuredGP (forcegp fit --model structured)."
        )
    posterior = posterior.to("cpu") if posterior.training.q.device.type != "cpu" else posterior
    if steps is not None:
        check_time_step(steps)
        integrator_named(integrator, posterior.system)
        if integrator not in STEPS:
            raise InvalidInput(
                f"an exported step is not {integrator!r}; give one of {', '.join(map(repr, STEPS))} as `integrator`."
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
    code = _code(posterior, reference)
    export = _Writer(
        posterior, reference, code, identifier(name or posterior.system.robot.name), jacobian, steps, integrator
    )
    with atomic_folder(folder, overwrite=False) as temporary:
        temporary.mkdir()
        export.write(temporary, source, "")
        differences = {} if unchecked else export.compared(temporary)
        apart = ", ".join(f"{what} {value:.1e}" for what, value in differences.items())
        states = f"at {STATES} states, training rows and others between and around them"
        said = f"Compared with forcegp {states}; largest difference / largest value: {apart}." if apart else ""
        export.write(temporary, source, said or "Nobody has compared this program with forcegp: run self_test.c.")
        files = {path.name: path.stat().st_size for path in sorted(temporary.iterdir())}
    inflation = None if reference.inflation is None else float(reference.inflation.max())
    return CExport(export.name, folder, files, differences, inflation)


def identifier(name: str) -> str:
    """A name for C and for files, of any text."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_").lower() or "robot"
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    return f"{plain}_model" if plain in TAKEN else plain


def _code(posterior: StructuredPosterior, made: Predictor) -> PredictorCode:
    """The programs. Raises InvalidInput that names the term of the prior, where one cannot be traced."""
    states = [x[:1] for x in (posterior.training.q, posterior.training.v, posterior.training.u)]
    physics = posterior._physics(posterior.system).traced
    try:
        calls = latent_calls(made.latent, made.prepared, made.compressed)
        return PredictorCode.of(physics, states, calls, made.compressed, made.widening)
    except InvalidInput as error:
        why = str(error).partition(", which the model's")[0].partition(";")[0]

    def holds(*terms: Any) -> bool:
        def function(q: Tensor, v: Tensor, u: Tensor) -> list[Tensor]:
            dynamics = posterior.dynamics(q, v, u)
            return [dynamics.H, *(z for term in terms for z in (term.mixing(dynamics), *term.features(dynamics)))]

        try:
            trace(function, states)
        except InvalidInput:
            return False
        return True

    terms = term_slices(posterior.model.prior, posterior.system.robot)
    found = [f"the prior's term {title!r}" for title, term, _ in terms if not holds(term)]
    what = "a kernel of the prior" if holds() else "a contact or known force of the system"
    raise InvalidInput(
        f"{found[0] if found and holds() else what} cannot be exported: {why}; write it with other operations and "
        "without branches on values, or fit without it."
    )


@dataclass(frozen=True)
class _Check:
    """What a function of the program gives at states (n, 3 nv), and how far it may be from that, relative."""

    function: str
    states: np.ndarray
    wanted: list[np.ndarray]
    tolerance: float

    @property
    def scales(self) -> list[float]:
        """The largest value of every output."""
        return [float(np.abs(x).max()) or 1.0 for x in self.wanted]


@dataclass(frozen=True, eq=False)
class _Writer:
    """The texts of all files, and their comparison with torch."""

    posterior: StructuredPosterior
    reference: Predictor
    code: PredictorCode
    name: str
    jacobian: bool
    dt: float | None
    integrator: str
    left_out: set[tuple[str, int]] = field(default_factory=set)

    @property
    def _kinds(self) -> list[str]:
        """The functions of the program."""
        chosen = {"covariance": self.reference.kind == "compressed", "linearize": self.jacobian}
        chosen |= {"step": self.dt is not None, "step_jacobian": self.dt is not None and self.jacobian}
        return ["mean", *(kind for kind, wanted in chosen.items() if wanted)]

    @cached_property
    def checks(self) -> list[_Check]:
        """Every function at states; derivatives, which may jump at training rows, and steps between these only."""
        training, made = self.posterior.training, self.reference
        sampled = torch.cat(sample_states(training, STATES, 0, STATES // 3), dim=-1)
        finite = self.posterior.predict(*sampled.chunk(3, dim=-1), covariance=False).mean.isfinite().all(-1)
        rows = min(STATES // 3, len(training.q))  # of the data themselves; then as many moved ones
        away = torch.randn(len(sampled), 1, generator=torch.Generator().manual_seed(0)).double()
        moved = sampled + 1e-3 * sampled.std(0).clamp_min(1e-3) * away  # as some of these are by nothing
        between = moved[rows : 2 * rows][finite[rows : 2 * rows]][:: 1 + rows // 33]
        tolerance = TABLE_TOLERANCE if self._table_error else MEAN_TOLERANCE[len(training.q) > 100]
        found = []
        for kind in self._kinds:
            states = between if kind in BETWEEN else sampled[finite]
            q, v, u = states.chunk(3, dim=-1)
            match kind:
                case "mean":
                    wanted = [self.posterior.predict(q, v, u, covariance=False).mean]
                case "covariance":
                    wanted = list(made(q, v, u))
                case "linearize":
                    a, *slopes = made.linearize(q, v, u)
                    wanted = [a, torch.cat(slopes, dim=-1)]
                case "step":
                    wanted = list(made.step(q, v, u, self.dt or 0.0, self.integrator))
                case _:
                    wanted = list(made.linearize_step(q, v, u, self.dt or 0.0, self.integrator)[:4])
            values = [x.detach().flatten(1).numpy() for x in wanted]
            function = f"{self.name}_{SUFFIXES.get(kind, kind)}"
            found.append(_Check(function, states.numpy(), values, tolerance * LOOSER.get(kind, 1.0)))
        return found

    def write(self, folder: Path, source: str | None, said: str) -> None:
        """All files; `said` is how good the program is."""
        start = [", ".join(map(repr, x.tolist())) for x in np.split(self.checks[0].states[0], 3)]
        program, stepped = _sections("model.c"), STEPS[self.integrator].replace("PROGRAM", self._stepped)
        words: dict[str, object] = {"NAME": self.name, "NV": self.code.nv, "DT": self.dt, "TITLE": self._title}
        words |= dict(zip(("START_Q", "START_V", "START_U"), start, strict=True))
        words |= dict(zip(("STORED", "CALLS"), self._stored(), strict=True))
        words |= {"STEP": stepped, "SLOPES": program[self.integrator], "CHECKED": said}
        words |= {"COMMENT": self._comment(said), "GIVEN": 0}
        words |= {"SOURCE": _plain(source or "not named"), "VERSION": importlib.metadata.version("forcegp")}
        if "covariance" in self._kinds:
            words["GIVEN"] = len(self.code.program("covariance").nodes)
        words = {word: _filled(str(value), words) for word, value in words.items()}
        functions = _filled("".join(program[kind] for kind in self._kinds), words)
        prototypes = re.findall(r"^(/\*[^{}]*?\*/\nint [^{]*?) {", functions, re.MULTILINE)
        words["PROTOTYPES"] = "\n".join(f"{found};" for found in prototypes)
        parts = [_filled(program["head"], words), *self._program(), _filled(program["calls"], words), functions]
        files = {f"{self.name}.c": "\n".join(parts), f"{self.name}.h": _filled(_template("model.h"), words)}
        for form in ("external", "acados") if self.dt is not None else ("external",):
            found = _sections(f"{form}.c")
            chosen = "".join(found[kind] for kind in ("head", *self._kinds) if kind in found)
            files[f"{self.name}_{form}.c"] = _filled(chosen, words)
        files |= {file: _filled(_template(file), words) for file in ALIKE}
        for file, content in files.items():
            (folder / file).write_text(content, encoding="ascii")

    def compared(self, folder: Path) -> dict[str, float]:
        """The largest difference by function. Nothing without a compiler; a warning says so."""
        try:
            PURPOSE.compiler()
        except CompilerError as error:
            warnings.warn(f"the exported program was not compared with forcegp: {error}", stacklevel=3)
            return {}
        options = ("-std=c99", "-O2", "-fPIC", "-shared", "-I", str(folder))
        found = {}
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / "checked.so"
            library = compile_library(f'#include "{self.name}.c"\n', options, path, f"{self.name}_mean", PURPOSE)
            for check in self.checks:
                found[check.function] = worst = self._difference(library[check.function], check)
                if not worst <= check.tolerance:
                    raise NumericalError(
                        f"{check.function} of the compiled program and forcegp differ by {worst:.2g} of the largest "
                        f"value, more than {check.tolerance:.2g}, so nothing was written; name another compiler by "
                        "the environment variable CC, or look at the model: its kernel matrix may be near singular."
                    )
        return found

    def _difference(self, function: Any, check: _Check) -> float:
        """The largest one; without a few states outside of a table, or where an implicit step has two solutions."""
        worst = 0.0
        for row, state in enumerate(check.states):
            made = [np.full(x.shape[1], np.nan) for x in check.wanted]
            bits = function(*(ctypes.c_void_p(x.ctypes.data) for x in (*np.split(state, 3), *made)))
            pairs = zip(made, check.wanted, check.scales, strict=True)
            apart = float(np.max([np.abs(x - wanted[row]).max() / scale for x, wanted, scale in pairs]))
            if bits or (not apart <= check.tolerance and self._solved(check, state, made)):
                self.left_out.add((check.function, row))
            else:
                worst = float(np.maximum(worst, apart))
        left_out = sum(function == check.function for function, _ in self.left_out)
        return worst if 2 * left_out < len(check.states) else np.inf

    def _solved(self, check: _Check, state: np.ndarray, made: list[np.ndarray]) -> bool:
        """Whether an implicit step ends at a solution, though at another one than torch finds."""
        if self.integrator != "implicit-midpoint" or "_step" not in check.function or self.dt is None:
            return False
        q, v, u = (torch.tensor(x) for x in np.split(state, 3))
        m = 0.5 * (v + torch.tensor(made[1]))
        if not bool(m.isfinite().all()):
            return False
        a = self.posterior.predict(q + 0.5 * self.dt * m, m, u, covariance=False).mean
        return float((m - v - 0.5 * self.dt * a).norm()) <= 1e-9 * (1.0 + float(m.norm()))

    @property
    def _stepped(self) -> str:
        return "slopes" if self.integrator == "implicit-midpoint" else "mean"

    def _program(self) -> Iterator[str]:
        """Tables and static functions."""
        names, code = [], self.code
        wanted = {"covariance": "mean_and_terms"} if "covariance" in self._kinds else {}
        slopes = self.jacobian or (self.dt is not None and self._stepped == "slopes")
        wanted |= {"mean": "mean"} | ({"linearize": "slopes"} if slopes else {})
        yield head(1)
        for k, table in enumerate(code.tables if "covariance" in wanted else code.tables[: len(code.sums)]):
            names.append(f"table{k}")
            yield f"static const double table{k}[] = {{\n{_numbers(table.tolist())}}};"
        yield f"static const double *const tables[] = {{{', '.join(names) or '0'}}};"
        for kind in (False, True) if slopes else (False,):
            yield from (part.c_source(1, kind) for part in code.sums)
        if "covariance" in wanted:
            yield from (part.roots_source(1, code.rank) for part in code.sums)
            yield code._covariance_source().replace("void covariance(", "void covariance_of(")
        for kind, function in wanted.items():
            program = code.program(kind)
            called = [part.name + ("_slopes" if kind == "linearize" else "") for part in code.sums]
            yield write_function(function, program.graph, program.nodes, 1, called)

    @property
    def _title(self) -> str:
        points = f"{len(self.posterior.training.q)} training points"
        return _plain(f"(q, v, u) -> a of {self.posterior.system.robot.name}, {self.posterior.description}, {points}")

    def _comment(self, said: str) -> str:
        robot, units = self.posterior.system.robot, units_for(self.posterior.system.robot)
        lines = [self._title, f"contacts: {len(self.posterior.system.contacts)}"]
        for k, name in enumerate(robot.joint_names):
            own = (f"{key} in {units[key] if isinstance(units[key], str) else units[key][k]}" for key in "qvua")
            lines.append(f"joint {k}: {name}, {', '.join(own)}")
        if self.reference.inflation is not None:
            wider = float(self.reference.inflation.max())
            lines.append(f"standard deviations: never below those of predict, at most {wider:.1%} above at its checks")
        if self._table_error:
            lines.append(f"tables of one input, relative error {self._table_error:.1e}, NaN outside their range")
        lines += [f"a step lasts {self.dt!r} s, by {self.integrator}"] if self.dt is not None else []
        return "\n".join(f"   {_plain(line)}" for line in [*lines, said])

    @property
    def _table_error(self) -> float:
        return max((part.functions.error for part in self.code.sums if isinstance(part, OneInputCall)), default=0.0)

    def _stored(self) -> tuple[str, str]:
        """Arrays and calls of the self-test."""
        arrays, calls = [], []
        for check in self.checks:
            rows = [k for k in range(min(len(check.states), 100)) if (check.function, k) not in self.left_out]
            rows = rows[:: max(1, len(rows) // STORED)]
            states, what = check.states[rows], check.function.removeprefix(f"{self.name}_")
            arrays.append(_array(f"{what}_states", states))
            given = [f"{what}_states[k]{f' + {j * self.code.nv}' if j else ''}" for j in range(3)]
            made = [f"r{j}" for j in range(len(check.wanted))]
            lines = [f"double {r}[{wanted.shape[1]}];" for r, wanted in zip(made, check.wanted, strict=True)]
            lines.append(f"if ({check.function}({', '.join(given + made)})) failures++;")
            for j, (wanted, scale) in enumerate(zip(check.wanted, check.scales, strict=True)):
                arrays.append(_array(f"{what}_{j}", wanted[rows]))
                bound = 10.0 * check.tolerance * scale
                lines.append(f'compare("{check.function}", r{j}, {what}_{j}[k], {wanted.shape[1]}, {bound!r});')
            calls.append(f"  for (int k = 0; k < {len(states)}; k++) {{\n    " + "\n    ".join(lines) + "\n  }")
        return "\n".join(arrays), "\n".join(calls)


def _template(file: str) -> str:
    return (Path(__file__).parent / "exported_c" / file).read_text(encoding="ascii")


def _sections(file: str) -> dict[str, str]:
    """The parts of a template, by the names above them."""
    return dict(re.findall(r"^//// (\S+)\n(.*?)(?=^////|\Z)", _template(file), re.MULTILINE | re.DOTALL))


def _filled(text: str, words: Mapping[str, object]) -> str:
    """The text with what stands for every `@WORD@`."""
    return re.sub("@([A-Z_]+)@", lambda found: str(words[found[1]]), text)


def _numbers(values: Sequence[float]) -> str:
    lines = (values[k : k + 6] for k in range(0, len(values), 6))
    return "".join(f"  {', '.join(value.hex() for value in line)},\n" for line in lines)


def _array(name: str, rows: np.ndarray) -> str:
    text = ",\n  ".join(f"{{{', '.join(value.hex() for value in row)}}}" for row in rows.tolist())
    return f"static const double {name}[{len(rows)}][{rows.shape[1]}] = {{\n  {text}}};"


def _plain(line: str) -> str:
    """Text that cannot end a comment, whatever a robot file calls its joints."""
    return re.sub(r"[^\x20-\x7e]|[@*?\\]", "_", line)
