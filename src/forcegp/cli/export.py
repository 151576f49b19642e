"""`forcegp export`: write a fitted model as a program for other tools."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.posterior
from forcegp.cli.command import MODEL, Command, unless_given
from forcegp.cli.terminal import Terminal, columns
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a fitted model as a program that needs no Python.

    c: C99 with the weights inside and <math.h> only, a header, an example, a self-test, a CMakeLists.txt, and forms
    for CasADi's external and acados' generic functions. It is compiled and compared with the model before it is there.
    casadi: CasADi functions with all derivatives, for casadi.Function.load (pip install 'forcegp[casadi]').

    For example:
      forcegp export run --to c --out deployed --covariance
      forcegp export run --to casadi --out planner --steps 0.02
      forcegp export run --to c --out mpc --jacobian --steps 0.02 --integrator implicit-midpoint
    """

    model: Annotated[Positional[Path], MODEL, arg(metavar="RUN")]
    """The folder that `forcegp fit --out` wrote."""
    to: Literal["c", "casadi"]
    """What to write."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write."""
    covariance: bool = False
    """With the covariance of the acceleration, which makes the program some 2 MB larger."""
    jacobian: bool = False
    """With derivatives in q, v and u. Compilers take some ten seconds for them."""
    steps: Annotated[float | None, unless_given("DT", "without", float)] = None
    """With x+ = f(x, u), a step of DT seconds."""
    integrator: Annotated[str | None, unless_given("NAME", "symplectic-euler", str)] = None
    """How the step of --steps is computed: symplectic-euler, rk4 or implicit-midpoint (stiff friction)."""
    unchecked: bool = False
    """Do not compile the program and compare it with the model."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Write and show."""
        if self.integrator is not None and self.steps is None:
            raise InvalidInput("--integrator was given without --steps, which sets the length of a step.")
        self.require_free(self.out)
        posterior = forcegp.load_posterior(self.model)
        names = ("to", "covariance", "jacobian", "steps", "integrator")
        content = {"run": str(self.model), **{name: getattr(self, name) for name in names}}
        with self.folder(self.out, content) as folder:
            found = TARGETS[self.to](self, terminal, posterior, folder)
        return {"out": str(self.out), **content, **found}


def _c(options: Export, terminal: Terminal, posterior: Any, folder: Path) -> dict[str, Any]:
    same = {name: getattr(options, name) for name in ("covariance", "jacobian", "steps", "unchecked")}
    integrator = options.integrator or "symplectic-euler"
    made = forcegp.export_c(posterior, folder, **same, integrator=integrator, source=str(options.model))
    terminal.show(
        columns(str(options.out), ["file", "bytes"], [[file, f"{size:,}"] for file, size in made.files.items()])
    )
    for function, apart in made.differences.items():
        terminal.show(f"{function}: at most {apart:.1e} of the largest value from forcegp's own")
    return {"name": made.name, "files": made.files, "differences": made.differences, "inflation": made.inflation}


def _casadi(options: Export, terminal: Terminal, posterior: Any, folder: Path) -> dict[str, Any]:
    for name in ("covariance", "jacobian", "unchecked"):
        if getattr(options, name):
            raise InvalidInput(f"--{name} is for --to c; CasADi functions have all derivatives, and no covariance.")
    given = {"steps": options.steps, "integrator": options.integrator or "symplectic-euler"}
    differences = forcegp.posterior.export_casadi(posterior, folder, **given)
    rows = [[file, f"{apart:.1e}"] for file, apart in differences.items()]
    terminal.show(columns(str(options.out), ["file", "largest difference / largest value"], rows))
    return {"differences": differences}


TARGETS: dict[str, Callable[[Export, Terminal, Any, Path], dict[str, Any]]] = {"c": _c, "casadi": _casadi}
"""What writes each target to a folder; a new one is a function here and a name in `Export.to`."""
