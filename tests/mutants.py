"""Faults put into the source one at a time, to see whether the fast tests notice: `make mutants`.

Each fault is drawn at random from the whole source: an operator or comparison exchanged, a number that doubles, a
condition that is negated. Annotations, raised errors, `__repr__` and assertions are left out, for no test should notice
these; nor guards against zero, which guard as well when they double, sizes of what is drawn, the line of the caller
that a warning names, and imports of type checkers. The tests of its package run in a copy of the checkout until one
fails. Survivors are printed, each to be killed by a test or understood; exit code 1 means that more than one in ten
survived.
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
ENOUGH = 0.9  # share of killed mutants that is asked for
NOT_COPIED = ".git", ".venv", ".*_cache", "build", "__pycache__"
LONGEST = 1200.0  # seconds of one run: a guard against a fault that never ends
GUARD = 1e-9  # the largest number that guards against zero or rounding
UNSEEN = {"stacklevel", "figsize", "dpi", "fontsize", "labelsize", "linewidth", "linestyle", "markersize", "zorder",
          "markeredgewidth", "alpha", "nbins", "bar_width", "cell_size"}  # fmt: skip
LEFT_OUT = ast.Raise | ast.Assert | ast.JoinedStr | ast.ImportFrom | ast.Import
EXCHANGED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.MatMult: ast.Mult, ast.Lt: ast.GtE,
    ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or,
    ast.Or: ast.And, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.BitOr: ast.BitAnd, ast.BitAnd: ast.BitOr,
}  # fmt: skip
COUNTED: dict[type[ast.AST], type[ast.AST]] = {ast.LtE: ast.Lt, ast.GtE: ast.Gt}
"""Whether the bound belongs is a fault where it is counted; of real numbers none is ever equal to it."""


def places(node: ast.AST) -> Iterator[ast.AST]:
    """Where a fault may be put below this node."""
    if isinstance(node, LEFT_OUT) or getattr(node, "name", "") in ("__repr__", "__str__"):
        return
    if getattr(node, "arg", "") in UNSEEN or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
        return
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and abs(node.value) > GUARD:  # type: ignore[arg-type]  # a number
        yield node
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.Compare | ast.If | ast.IfExp):
        yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name not in ("annotation", "returns", "decorator_list") and isinstance(child, ast.AST):
                yield from places(child)


def _counts(node: ast.AST) -> bool:
    return type(getattr(node, "value", None)) is int or ast.unparse(node).startswith("len(")


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
        exchanged = EXCHANGED | COUNTED if any(map(_counts, (node.left, *node.comparators))) else EXCHANGED
        node.ops[0] = exchanged[type(node.ops[0])]()  # type: ignore[call-overload]  # of comparisons
    elif isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = EXCHANGED.get(type(node.op), ast.Add)()  # type: ignore[assignment]  # of the same kind
    after = ast.unparse(node.test if isinstance(node, ast.If) else node)
    return ast.unparse(ast.fix_missing_locations(tree)), f"{node.lineno}: {before}  ->  {after}"  # type: ignore[attr-defined]


def noticed(package: str, folder: Path) -> bool:
    """Whether a test of the package fails in this copy; modules outside have a folder or the tests outside folders."""
    outside = [str(file) for file in sorted((folder / "tests").glob("test_*.py"))]
    tests = [f"tests/{package}"] if (folder / "tests" / package).is_dir() else outside
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = os.environ | one | {"PYTHONPATH": f"{folder / 'src'}{os.pathsep}{folder}"}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help="draws from these only (default: from all)")
    parser.add_argument("--count", type=int, default=60, help="mutants (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="draws them")
    given, survived, sound = parser.parse_args(), 0, set()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "forcegp")
        shutil.copytree(REPOSITORY, folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
        source = folder / "src" / "forcegp"
        files = [file for p in given.packages or [""] for file in sorted((source / p).rglob("*.py"))]
        known = [(file, k) for file in files for k in range(len(list(places(ast.parse(file.read_text())))))]
        drawn = random.Random(given.seed).sample(known, min(given.count, len(known)))
        for file, k in drawn:
            package = file.relative_to(source).parts[0].removesuffix(".py")
            if package not in sound and noticed(package, folder):
                raise SystemExit(f"tests of {package} fail without a mutant, so that its kills mean nothing.")
            sound.add(package)
            before = file.read_text()
            text, change = mutated(before, k)
            file.write_text(text)
            killed = noticed(package, folder)
            file.write_text(before)
            survived += not killed
            print(f"{'killed  ' if killed else 'SURVIVED'}  {file.relative_to(source)}:{change}", flush=True)
    print(f"{len(drawn) - survived} of {len(drawn)} were noticed")
    return int(survived > (1.0 - ENOUGH) * len(drawn))


if __name__ == "__main__":
    sys.exit(main())
