"""The faults of `make mutants`: a sample of what cosmic-ray's operators make of a package.

Drawn by digests of the line and the operator, so the same source has the same sample, and an edit changes little of it.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import itertools
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent

# cosmic-ray replaces each operator by each other; most of those fail at once on floats and would flatter the count.
ARITHMETIC = [pair for pair in itertools.permutations(("Add", "Sub", "Mul", "Div"), 2)]
ARITHMETIC += [("Pow", "Mul"), ("FloorDiv", "Mul"), ("Mod", "Sub"), ("BitAnd", "BitOr"), ("BitOr", "BitAnd")]
ORDER = [("Lt", "LtE"), ("Lt", "Gt"), ("LtE", "Lt"), ("LtE", "Gt"), ("Gt", "GtE"), ("Gt", "Lt"), ("GtE", "Gt")]
ORDER += [("GtE", "Lt"), ("Eq", "NotEq"), ("NotEq", "Eq"), ("Is", "IsNot"), ("IsNot", "Is")]
OPERATORS = [f"ReplaceBinaryOperator_{old}_{new}" for old, new in ARITHMETIC]
OPERATORS += [f"ReplaceComparisonOperator_{old}_{new}" for old, new in ORDER]
OPERATORS += ["ReplaceUnaryOperator_USub_UAdd", "ReplaceUnaryOperator_Delete_Not", "AddNot", "RemoveDecorator"]
OPERATORS += ["ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd", "NumberReplacer"]
OPERATORS += ["ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ExceptionReplacer", "ZeroIterationForLoop"]
NO_BEHAVIOUR = ("cache", "override", "overload", "runtime_checkable", "abstractmethod", "final")
"""Words of decorators that change the time, the types or the reader's view, and no result."""

Position = tuple[int, int]


@dataclass(frozen=True)
class Mutant:
    """One fault: where it is, which lines execute it, and both texts of the module."""

    module: str
    operator: str
    lines: frozenset[int]
    original: str
    mutated: str

    def __str__(self) -> str:
        return f"{self.module}: {'  ->  '.join(self.change())}"

    def change(self) -> tuple[str, str]:
        """The lines that differ, without indentation: before and after."""
        texts = difflib.ndiff(self.original.splitlines(), self.mutated.splitlines())
        changed = [line for line in texts if line[0] in "+-"]
        old, new = (" ".join(line[1:].strip() for line in changed if line[0] == sign) for sign in "-+")
        return old, new


def digest(*texts: str) -> str:
    """Short name of these texts."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def left_out(node: ast.AST) -> bool:
    """Whether no test should notice a change in here."""
    if isinstance(node, ast.FunctionDef):
        return node.name in ("__repr__", "__str__")
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func).endswith(("warn", "report", "progress"))
    if isinstance(node, ast.Assign | ast.AnnAssign):
        names = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
        return names.endswith("_BYTES")  # sizes of blocks
    return isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert | ast.ImportFrom)


def read(source: str) -> tuple[list[tuple[Position, Position]], dict[int, frozenset[int]]]:
    """Spans that are left out, and for every line those that are executed where that line has an effect."""
    tree, spans, executed = ast.parse(source), [], {}
    texts = source.splitlines()

    def column(line: int, offset: int) -> int:
        return len(texts[line - 1].encode()[:offset].decode())  # ast counts bytes, parso characters

    def skip(node: ast.expr | ast.stmt) -> None:
        end_line, end_offset = node.end_lineno or 0, node.end_col_offset or 0
        spans.append(((node.lineno, column(node.lineno, node.col_offset)), (end_line, column(end_line, end_offset))))

    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Lambda)]
    bodies = {node: range(body(node)[0].lineno, (node.end_lineno or 0) + 1) for node in functions}
    in_functions = frozenset(itertools.chain.from_iterable(bodies.values()))
    for node in ast.walk(tree):  # outer before inner, so that the innermost statement is written last
        if isinstance(node, ast.expr | ast.stmt) and left_out(node):
            skip(node)
        for annotation in (getattr(node, name, None) for name in ("annotation", "returns")):
            if isinstance(annotation, ast.expr):
                skip(annotation)
        if isinstance(node, ast.keyword) and node.arg == "strict":
            skip(node.value)  # of zip: a guard, as an assertion is
        if isinstance(node, ast.stmt):
            inner = [child.lineno for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)]
            last = max(min(inner, default=(node.end_lineno or 0) + 1) - 1, node.lineno)
            first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", []))])
            where = frozenset(range(first, last + 1))
            if isinstance(node, ast.FunctionDef):
                where = frozenset(bodies[node])
            elif node.lineno not in in_functions:
                where = in_functions  # runs at import: whatever uses the module may depend on it
            executed.update(dict.fromkeys(range(first, last + 1), where))
    for node in tree.body:
        value = node.value if isinstance(node, ast.Assign) else None
        if isinstance(value, ast.Subscript) or (isinstance(value, ast.BinOp) and isinstance(value.op, ast.BitOr)):
            skip(node)  # an alias of types
    return spans, executed


def body(function: ast.FunctionDef | ast.Lambda) -> list[ast.stmt] | list[ast.expr]:
    """What a call of this function executes."""
    return function.body if isinstance(function, ast.FunctionDef) else [function.body]


def mutants(package: str, count: int) -> list[Mutant]:
    """The sample of a package."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    operators = {name: get_operator(f"core/{name}")() for name in OPERATORS}
    ranked: list[tuple[str, str, str, int, int]] = []
    sources = {
        str(file.relative_to(REPOSITORY / "src")): file.read_text() for file in python_files(f"src/forcegp/{package}")
    }
    parts = {module: read(source) for module, source in sources.items()}
    for module, source in sources.items():
        texts, nodes = source.splitlines(), list(ast_nodes(get_ast(source)))
        here: dict[Position, list[tuple[str, str, str, int, int]]] = {}
        for name, operator in operators.items():
            places = ((node, place) for node in nodes for place in operator.mutation_positions(node))
            seen: Counter[str] = Counter()
            for occurrence, (node, (start, end)) in enumerate(places):
                if any(first <= start and end <= last for first, last in parts[module][0]):
                    continue
                if name.startswith("ReplaceBinary") and node.parent.type in ("parameters", "lambdef"):
                    continue  # `*` and `/` between parameters
                if name == "RemoveDecorator" and any(word in node.get_code() for word in NO_BEHAVIOUR):
                    continue
                text = texts[start[0] - 1]
                if name == "NumberReplacer" and text[: start[1]].endswith("None])[..., ") and occurrence % 2:
                    continue  # -1 for 0 where the axis has one entry
                text = text.strip()
                seen[text] += 1
                rank = digest(module, text, name, str(seen[text]))
                here.setdefault(start, []).append((rank, module, name, occurrence, start[0]))
        ranked.extend(min(choices) for choices in here.values())  # one fault for each place
    sample: list[Mutant] = []
    for _, module, name, occurrence, line in sorted(ranked):
        mutated = mutate_code(sources[module], operators[name], occurrence)
        if len(sample) < count and mutated not in (None, sources[module]) and compiles(mutated):
            lines = parts[module][1].get(line, frozenset({line}))
            sample.append(Mutant(module, name, lines, sources[module], mutated))
        if len(sample) == count:
            break
    return sample


def compiles(source: str) -> bool:
    """Whether this is Python; `def f(*, a)` is not a product."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return bool(compile(source, "mutant", "exec"))
        except SyntaxError:
            return False


def python_files(folder: str) -> list[Path]:
    """All Python files below a folder of the repository."""
    return sorted((REPOSITORY / folder).rglob("*.py"))
