"""Faults put into the source one at a time, to see whether the fast tests notice: `make mutants`.

Each fault is drawn at random from a package: an operator or comparison exchanged, a number that doubles, a condition
that is negated. Annotations, raised errors, `__repr__` and assertions are left out, for no test should notice these.
The package's tests run in a copy of the checkout until one fails. Survivors are printed, each to be killed by a test
or understood; exit code 1 means that more than one in ten survived.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = ("inference", "mechanics", "robots", "forces", "data", "evidence", "posterior", "fit", "scores")
ENOUGH = 0.9
"""Share of killed mutants that is asked for."""
LONGEST = 1200.0  # seconds of one run: a guard against a fault that never ends
LEFT_OUT = ast.Raise | ast.Assert | ast.JoinedStr | ast.ImportFrom | ast.Import
EXCHANGED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.MatMult: ast.Mult, ast.Lt: ast.GtE,
    ast.LtE: ast.Lt, ast.Gt: ast.LtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or,
    ast.Or: ast.And,
}  # fmt: skip


def places(node: ast.AST) -> Iterator[ast.AST]:
    """Where a fault may be put below this node."""
    if isinstance(node, LEFT_OUT) or getattr(node, "name", "") in ("__repr__", "__str__"):
        return
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value:
        yield node
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.Compare | ast.If | ast.IfExp):
        yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name not in ("annotation", "returns", "decorator_list") and isinstance(child, ast.AST):
                yield from places(child)


def mutated(source: str, place: int) -> tuple[str, str]:
    """The source with a fault at this place, and what was changed."""
    tree = ast.parse(source)
    node = list(places(tree))[place]
    before = ast.unparse(node.test if isinstance(node, ast.If) else node)
    if isinstance(node, ast.Constant):
        node.value = 2 * node.value  # type: ignore[operator]  # a number
    elif isinstance(node, ast.If | ast.IfExp):
        node.test = ast.UnaryOp(ast.Not(), copy.copy(node.test))
    elif isinstance(node, ast.Compare):
        node.ops[0] = EXCHANGED.get(type(node.ops[0]), ast.Is)()  # type: ignore[call-overload]  # of comparisons
    elif isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = EXCHANGED.get(type(node.op), ast.Add)()  # type: ignore[assignment]  # of the same kind
    after = ast.unparse(node.test if isinstance(node, ast.If) else node)
    return ast.unparse(ast.fix_missing_locations(tree)), f"{node.lineno}: {before}  ->  {after}"  # type: ignore[attr-defined]


def noticed(package: str, folder: Path) -> bool:
    """Whether a test of the package fails in this copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"tests/{package}"]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = os.environ | one | {"PYTHONPATH": f"{folder / 'src'}{os.pathsep}{folder}"}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def main() -> int:
    """Draw, run, and print what survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", default=PACKAGES, metavar="PACKAGE", help=f"of {', '.join(PACKAGES)}")
    parser.add_argument("--count", type=int, default=10, help="mutants of each package (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="draws them")
    given = parser.parse_args()
    survived, total = 0, 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "forcegp")
        shutil.copytree(REPOSITORY, folder, ignore=shutil.ignore_patterns(".*", "build", "__pycache__"))
        for package in given.packages:
            if noticed(package, folder):
                raise SystemExit(f"the tests of {package} fail without a mutant, so that its kills mean nothing.")
            generator = random.Random(f"{given.seed}{package}")
            files = sorted((folder / "src" / "forcegp" / package).rglob("*.py"))
            known = [(file, k) for file in files for k in range(len(list(places(ast.parse(file.read_text())))))]
            for file, k in generator.sample(known, min(given.count, len(known))):
                source = file.read_text()
                text, change = mutated(source, k)
                file.write_text(text)
                killed = noticed(package, folder)
                file.write_text(source)
                survived, total = survived + (not killed), total + 1
                told = "killed  " if killed else "SURVIVED"
                print(f"{told}  {file.relative_to(folder / 'src' / 'forcegp')}:{change}", flush=True)
    print(f"{total - survived} of {total} were noticed")
    return int(survived > (1.0 - ENOUGH) * total)


if __name__ == "__main__":
    sys.exit(main())
