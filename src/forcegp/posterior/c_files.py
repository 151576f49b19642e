"""The texts of a fitted model as C99: its program, what calls it, and a self-test with stored results."""

import importlib.metadata
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from forcegp.codegen.c_writer import c_text, filled, head, sections, write_function
from forcegp.codegen.tracing import trace
from forcegp.data import units_for
from forcegp.errors import InvalidInput
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import require_actuated
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.programs import WITH_SLOPES, Programs

STORED = 10  # states of the self-test
MEMORY_OF_MONITOR = {"REMEMBER": "memory", "UNKNOWN": "unknown"}  # parts of a monitor whose friction remembers
FILES = ("model.h", "model.hpp", "CMakeLists.txt", "example.c", "self_test.c", "README.txt")


def identifier(name: str) -> str:
    """A name for C, C++ and files, of any text, but no word of theirs, of CasADi or of standard headers (taken.txt)."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name)[:60].strip("_").lower() or "robot"
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    taken = plain.endswith("_t") or plain in c_text(__name__, "exported_c/taken.txt").split()  # POSIX reserves ..._t
    return f"{plain}_model" if taken else plain


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
    monitor: Any = None

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
        start = [", ".join(map(repr, x.tolist())) for x in split(checks[0].states[0], self.code.sizes)]
        program, implicit = sections(__name__, "exported_c/model.c"), self.integrator == "implicit-midpoint"
        stepped = "" if self.dt is None else self.code.step_source(self.integrator, "slopes" if implicit else "mean")
        words: dict[str, object] = {"NAME": self.name, "NV": nv, "NQ": nq, "NU": nu, "DT": self.dt}
        words |= dict(zip(("START_Q", "START_V", "START_U"), start, strict=True))
        words |= dict(zip(("STORED", "CALLS"), self._stored(checks), strict=True))
        words |= {"STEP": stepped, "SLOPES": program[self.integrator], "CHECKED": said}
        words |= {"COMMENT": self._comment(said), "IMPLICIT": int(implicit)}
        words |= {"SOURCE": _plain(source or "not named"), "VERSION": importlib.metadata.version("forcegp")}
        moving = not self.code.space.is_vector_space
        words |= {"ALL": nq + nv + nu, "X": nq + nv, "COLUMNS": 2 * nv + nu, "TITLE": self._title}
        words["STATE"] = "step from q, v, u" if moving else "q, v, u"
        words["ADVANCE"] = sections(__name__, "exported_c/advance.c")["turned" if moving else "added"]
        if "covariance" in self.kinds:
            words["GIVEN"] = len(self.code.program("covariance").nodes)
            words["GIVEN_PARTS"] = len(self.code.program("deviations").outputs["covariance"])
        memory, physics = self.posterior.model.memory.names, self.code.physics
        words |= {"MEMORY": len(memory), "COLUMN": self.posterior.model.memory_column, "PARTS": len(physics.names)}
        words |= {"CONTACTS": len(self.posterior.model.contacts), "TERMS": len(physics.terms)}
        words |= {"NAMED": _plain(", ".join(physics.names)), "AFFINE": int(self.solvable and self.code.affine)}
        words |= self._of_monitor(program)
        for _ in range(2):  # words of words
            words = {word: filled(str(value), words) for word, value in words.items()}
        more = {"integrate": moving, "remember": bool(memory), "monitor": self.monitor is not None}
        kinds = (*(kind for kind, wanted in more.items() if wanted), *self.kinds)
        functions = filled("".join(program[kind] for kind in kinds), words)
        prototypes = re.findall(r"^(/\*[^{}]*?\*/\nint [^{]*?) {", functions, re.MULTILINE)
        words["PROTOTYPES"] = "\n".join(f"{found};" for found in prototypes)
        parts = [filled(program["head"], words), *self._program(), filled(program["calls"], words), functions]
        wrapped = sections(__name__, "exported_c/wrapped.hpp")
        words["CPP"] = filled("\n".join(wrapped[kind] for kind in kinds if kind in wrapped), words)
        (folder / f"{self.name}.c").write_text("\n".join(parts), encoding="ascii")
        for file in FILES:
            text = filled(c_text(__name__, f"exported_c/{file}"), words)
            (folder / file.replace("model", self.name)).write_text(text, encoding="ascii")

    def _of_monitor(self, program: Mapping[str, str]) -> dict[str, object]:
        if (monitor := self.monitor) is None:
            return {"STATE_OF_MONITOR": ""}
        words: dict[str, object] = {"STATE_OF_MONITOR": program["monitor_state"], "LINKS": len(monitor.ends)}
        remembers = bool(self.posterior.model.memory.names)
        words |= {name: program[f"monitor_{kind}"] if remembers else "" for name, kind in MEMORY_OF_MONITOR.items()}
        words |= {"OPEN": program["monitor_open"] if "covariance" in self.kinds else ""}
        words["LINK_NAMES"] = ", ".join(f'"{_plain(name).replace(chr(34), chr(39))}"' for name in monitor.ends)
        return words | {word: ", ".join(map(repr, np.ravel(x).tolist())) for word, x in monitor.numbers.items()}

    def _program(self) -> Iterator[str]:
        names, code = [], self.code
        wanted = {"covariance": "mean_and_terms"} if "covariance" in self.kinds else {}
        slopes = self.jacobian or (self.dt is not None and self.integrator == "implicit-midpoint")
        wanted |= {"mean": "mean"} | ({"linearize": "slopes"} if slopes else {})
        wanted |= {kind: kind for kind in ("components", "deviations") if kind in self.kinds}
        wanted |= {"forces": "forces_at"} if self.solvable or self.monitor is not None else {}
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
        if self.monitor is not None:
            graph, found = trace(self.monitor.levers, [code.space.neutral()])
            yield write_function("levers", graph, [node for x in found for node in x.flatten().tolist()], 1)
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


def split(rows: np.ndarray, sizes: Sequence[int]) -> list[np.ndarray]:
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
