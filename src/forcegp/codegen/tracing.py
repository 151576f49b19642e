"""From a function written in torch to a graph: the tensor operations of one call, taken apart into scalars.

Loops and branches of Python leave no trace. Operations that only move numbers run on tensors of node numbers. Small
dense linear algebra stands here without branches on values; derivatives are right as well.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor, _decomp
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from typing_extensions import override

from forcegp.codegen.graph import ONE, UNARY, ZERO, Graph
from forcegp.errors import InvalidInput

MOVING = frozenset(
    {
        *("view", "_unsafe_view", "reshape", "expand", "permute", "transpose", "t", "unsqueeze", "squeeze", "flip"),
        *("select", "slice", "diagonal", "as_strided", "split", "split_with_sizes", "unbind", "cat", "stack", "repeat"),
        *("clone", "alias", "detach", "lift_fresh_copy", "index", "index_select", "gather", "new_zeros", "new_ones"),
        *("select_scatter", "slice_scatter", "diag_embed", "tril", "triu", "zeros_like", "ones_like"),
    }
)
"""Operations that are the same on node numbers: nodes 0 and 1 hold 0.0 and 1.0."""

CREATION = ("dtype", "layout", "device", "pin_memory", "memory_format")  # keywords without an effect on values

INDEXED = ("index", "index_select", "gather")  # those whose further tensors are indices, which must be known

OUTWARDS = (Tensor.numpy, Tensor.tolist, Tensor.__array__)
BRANCH = "a branch on the values of a tensor, or numbers taken out of it"

Tensors = Sequence[Tensor]
NAMES = {"neg": "negate", "abs": "absolute", "add": "add", "sub": "subtract", "mul": "multiply", "div": "divide"}


def trace(
    function: Callable[..., Tensors], examples: Tensors, graph: Graph | None = None, inputs: Sequence[int] = ()
) -> tuple[Graph, list[Tensor]]:
    """The graph of function(*examples) -> tensors, and the nodes of its outputs in their shapes.

    Inputs are flattened in order; with `graph` they are its `inputs`. InvalidInput names what a graph cannot hold.
    """
    examples = [x.detach().clone() for x in examples]
    graph = Graph(sum(x.numel() for x in examples)) if graph is None else graph
    nodes = torch.tensor(list(inputs) or graph.inputs).split([x.numel() for x in examples])
    recorded = _Recording(graph)
    for x, part in zip(examples, nodes, strict=True):
        recorded.note(x, _Numbers(part.view(x.shape)))
    with torch.no_grad(), StraightLineAlgebra(recorded), recorded:
        results = list(function(*examples))
    return graph, [_numbers(graph, recorded.numbers_of(x)).nodes for x in results]


class StraightLineAlgebra(TorchFunctionMode):
    """Within it, the functions of torch.linalg that Gauss' principle uses are those of this module.

    What takes `recorded` numbers out of torch, where they would be constants without a word, is refused.
    """

    def __init__(self, recorded: "_Recording | None" = None) -> None:
        super().__init__()
        self.recorded = recorded

    @override
    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if func in OUTWARDS and self.recorded is not None and self.recorded.numbers_of(args[0]) is not args[0]:
            raise _refused(BRANCH)
        if func is torch.linalg.cholesky:
            return cholesky(*args)
        if func is torch.linalg.solve_triangular and not kwargs.get("upper", False) and kwargs.get("left", True):
            return solve_lower(*args)
        if func is torch.linalg.pinv:
            rows, columns = args[0].shape[-2:]
            tolerance = kwargs.get("rtol", max(rows, columns) * torch.finfo(args[0].dtype).eps)  # torch's own default
            return pseudo_inverse(args[0].mT, tolerance).mT if rows > columns else pseudo_inverse(args[0], tolerance)
        return func(*args, **kwargs)


def cholesky(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor (..., n, n); NaN where the matrix is not positive definite."""
    columns, rest = [], matrix
    for k in range(matrix.shape[-1]):
        column = rest[..., :, k] / rest[..., k, k, None].sqrt()
        column = torch.cat([torch.zeros_like(column[..., :k]), column[..., k:]], dim=-1)
        rest = rest - column[..., :, None] * column[..., None, :]
        columns.append(column)
    return torch.stack(columns, dim=-1)


def solve_lower(lower: Tensor, right: Tensor) -> Tensor:
    """lower^-1 right (..., n, k)."""
    rows: list[Tensor] = []
    for i in range(lower.shape[-1]):
        value = right[..., i, :]
        for k, row in enumerate(rows):
            value = value - lower[..., i, k, None] * row
        rows.append(value / lower[..., i, i, None])
    return torch.stack(rows, dim=-2)


def pseudo_inverse(matrix: Tensor, tolerance: float) -> Tensor:
    """The pseudo-inverse (..., n, m) of a matrix (..., m, n) with m <= n, what is within the tolerance dropped."""
    # From an orthonormal basis Q of the rows: A = L Q with L = A Q^T, L^T = R U, A^+ = Q^T R^-T U
    Q = _basis(matrix, tolerance)
    R, U = _lower_and_orthonormal((matrix @ Q.mT).mT)
    R = R + torch.diag_embed(torch.where(R.diagonal(dim1=-2, dim2=-1) > 0.0, 0.0, 1.0))
    return (U.mT @ solve_lower(R, Q)).mT


def _basis(matrix: Tensor, tolerance: float) -> Tensor:
    """Orthonormal rows (..., m, n) that span those of the matrix, the longest remainder first."""
    rest, basis, largest = matrix, matrix[..., :0, :], None
    for k in range(matrix.shape[-2]):
        squares = (rest * rest).sum(-1)
        row, square = rest[..., 0, :], squares[..., 0]
        for i in range(1, matrix.shape[-2]):
            longer = squares[..., i] > square
            row = torch.where(longer[..., None], rest[..., i, :], row)
            square = torch.where(longer, squares[..., i], square)
        largest = square if largest is None else largest
        if k:  # again, since rounding of the remainder is not orthogonal
            row = row - ((basis @ row[..., None])[..., 0][..., None, :] @ basis)[..., 0, :]
        unit = _unit(row, tolerance**2 * largest)[0]
        basis = torch.cat([basis, unit[..., None, :]], dim=-2)
        rest = rest - (rest @ unit[..., None]) * unit[..., None, :]
    return basis


def _lower_and_orthonormal(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """L (..., m, m) and Q (..., m, n), L Q the matrix of independent or zero rows, made orthogonal twice."""
    count, lower, basis = matrix.shape[-2], [], matrix[..., :0, :]
    for k, row in enumerate(matrix.unbind(-2)):
        along = torch.zeros_like(matrix[..., :k, 0])
        for _ in range(2 if k else 0):
            share = (basis @ row[..., None])[..., 0]
            row, along = row - (share[..., None, :] @ basis)[..., 0, :], along + share
        unit, length = _unit(row, torch.zeros_like(row[..., 0]))
        basis = torch.cat([basis, unit[..., None, :]], dim=-2)
        lower.append(torch.cat([along, length[..., None], torch.zeros_like(matrix[..., : count - k - 1, 0])], dim=-1))
    return torch.stack(lower, dim=-2), basis


def _unit(row: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """The row over its length, and that; zeros where its square is not above the least."""
    square = (row * row).sum(-1)
    kept = square > least
    length = torch.where(kept, torch.where(kept, square, torch.ones_like(square)).sqrt(), torch.zeros_like(square))
    unit = row / torch.where(kept, length, torch.ones_like(length))[..., None]
    return torch.where(kept[..., None], unit, 0.0 * row), length


class _Recording(TorchDispatchMode):
    """Runs operations, and keeps the node numbers of what depends on the inputs."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.graph, self._known = graph, {}

    def note(self, tensor: Tensor, numbers: "_Numbers") -> None:
        """The nodes of a tensor, which is kept alive so that no other gets its id."""
        self._known[id(tensor)] = tensor, numbers

    def numbers_of(self, value: Any) -> Any:
        """The nodes of a tensor that depends on the inputs; anything else as it is."""
        return self._known[id(value)][1] if id(value) in self._known else value

    @classmethod
    @override
    def _should_skip_dynamo(cls) -> bool:
        return False  # whose import takes longer than all else here

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if _name(func) not in HANDLERS or _name(func) == "full_like":  # a constant, which may be filled in place
            with self:
                found = _decompositions().get(func, func.decompose)(*args, **kwargs)  # type: ignore[reportOptionalCall]  # it is a method
            if found is not NotImplemented:
                return found
        result, given = func(*args, **kwargs), _mapped(self.numbers_of, (args, kwargs))
        if _holds_numbers(given):
            numbers = _apply(self.graph, func, *given)
            tensors, found = (x if isinstance(x, list | tuple) else [x] for x in (result, numbers))
            for tensor, part in zip(tensors, found, strict=True):
                if isinstance(part, _Numbers):
                    self.note(tensor, part)
        return result


@cache
def _decompositions() -> dict[Any, Callable[..., Any]]:
    """What makes few operations of many; the public function has more, and takes a second to import it."""
    return getattr(_decomp, "_core_aten_decompositions_post_autograd", _decomp.core_aten_decompositions)()


@cache
def _name(target: Any) -> str:
    return getattr(target, "__name__", str(target)).split(".")[0]


class _Numbers:
    """A tensor of numbers that depend on the inputs, as the numbers of their nodes."""

    def __init__(self, nodes: Tensor) -> None:
        self.nodes = nodes


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    """The function of every leaf; for these small trees `torch.utils._pytree` took a third of the time of a trace."""
    if isinstance(value, tuple | list):
        return type(value)(_mapped(function, each) for each in value)
    return {k: _mapped(function, each) for k, each in value.items()} if isinstance(value, dict) else function(value)


def _holds_numbers(value: Any) -> bool:
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, tuple | list):
        return isinstance(value, _Numbers)
    return any(map(_holds_numbers, value))


def _numbers(graph: Graph, value: _Numbers | Tensor | float | int) -> _Numbers:
    if isinstance(value, _Numbers):
        return value
    tensor = torch.as_tensor(value, dtype=torch.float64)
    return _Numbers(torch.tensor([graph.constant(x) for x in tensor.flatten().tolist()]).view(tensor.shape).long())


def _apply(graph: Graph, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """One operation of torch on constants or node numbers."""
    name, known = _name(target), not _holds_numbers(args[1:])
    if name in MOVING and (known or name not in INDEXED):
        return _moved(graph, target, args, kwargs, name in INDEXED)
    if name == "_to_copy" and kwargs.get("dtype", torch.float64) in (torch.float64, torch.bool):
        return args[0]
    if name == "index" and len(args[1]) == 1 and _numbers(graph, args[0]).nodes.dim() == 1:
        return _looked_up(graph, *args)
    if name in HANDLERS:
        return HANDLERS[name](graph, *args, **{k: v for k, v in kwargs.items() if k not in CREATION})
    if NAMES.get(name, name) in UNARY:
        return _elementwise(graph, lambda x: graph.apply(NAMES.get(name, name), x), args[0])
    raise _refused(BRANCH if name == "_local_scalar_dense" else f"the operation {target} of torch")


def _refused(what: str) -> InvalidInput:
    seen = f"compiled code cannot hold {what}, which the model's surface, known force or prior uses"
    return InvalidInput(f"{seen}; write it with other operations, or give compile=False, whose results are the same.")


def _moved(graph: Graph, target: Any, args: tuple, kwargs: dict[str, Any], indexed: bool) -> Any:
    def nodes(value: Any) -> Any:
        return _numbers(graph, value).nodes if isinstance(value, _Numbers | Tensor) else value

    args = (nodes(args[0]), *args[1:]) if indexed else _mapped(nodes, args)
    result = target(*args, **{key: value for key, value in kwargs.items() if key not in CREATION})
    return _Numbers(result) if isinstance(result, Tensor) else [_Numbers(part) for part in result]


def _looked_up(graph: Graph, values: Any, indices: list[Any]) -> _Numbers:
    """Entries of a vector at places that depend on the inputs."""
    table = _numbers(graph, values).nodes.tolist()
    known = [graph.value(node) for node in table]
    if None not in known:
        return _elementwise(graph, lambda place: graph.look_up(known, place), indices[0])  # type: ignore[arg-type]  # none is None

    def one(place: int) -> int:
        found = table[0]
        for k, value in enumerate(table[1:], 1):
            found = graph.apply("choose", graph.apply("equal", place, graph.constant(k)), value, found)
        return found

    return _elementwise(graph, one, indices[0])


def _elementwise(graph: Graph, function: Callable[..., int], *values: Any) -> _Numbers:
    tensors = torch.broadcast_tensors(*(_numbers(graph, value).nodes for value in values))
    results = [function(*nodes) for nodes in zip(*(x.flatten().tolist() for x in tensors), strict=True)]
    return _Numbers(torch.tensor(results, dtype=torch.long).view(tensors[0].shape))


def _binary(operation: str, swapped: bool = False) -> Callable[..., _Numbers]:
    def handler(graph: Graph, x: Any, y: Any, alpha: Any = 1.0, rounding_mode: None = None) -> _Numbers:
        if alpha != 1.0:
            y = _elementwise(graph, lambda a, b: graph.apply("multiply", a, b), y, float(alpha))
        x, y = (y, x) if swapped else (x, y)
        return _elementwise(graph, lambda a, b: graph.apply(operation, a, b), x, y)

    return handler


def _negated(graph: Graph, m: Any) -> _Numbers:
    return _elementwise(graph, lambda a: graph.apply("subtract", ONE, a), m)


def _power(graph: Graph, x: Any, exponent: Any) -> _Numbers:
    def one(a: int, b: int) -> int:
        match graph.value(b):
            case 0.5:
                return graph.apply("sqrt", a)
            case 1.0:
                return a
            case 2.0 | 3.0 as known:
                return graph.apply("multiply", a, one(a, graph.constant(known - 1.0)))
            case -0.5 | -1.0 | -2.0 as known:
                return graph.apply("divide", ONE, one(a, graph.constant(-known)))
        return graph.apply("power", a, b)

    return _elementwise(graph, one, x, exponent)


def _clamp(graph: Graph, x: Any, low: Any = None, high: Any = None) -> _Numbers:
    if low is not None:
        x = _elementwise(graph, lambda a, b: graph.apply("choose", graph.apply("less", a, b), b, a), x, low)
    if high is not None:
        x = _elementwise(graph, lambda a, b: graph.apply("choose", graph.apply("less", b, a), b, a), x, high)
    return x


def _sum(graph: Graph, x: _Numbers, dim: Any = None, keepdim: bool = False) -> _Numbers:
    nodes = x.nodes
    dims = list(range(nodes.dim())) if dim is None or dim == [] else [d % nodes.dim() for d in dim]
    kept = [d for d in range(nodes.dim()) if d not in dims]
    count, width = (math.prod(nodes.shape[d] for d in which) for which in (kept, dims))
    rows = nodes.permute(*kept, *dims).reshape(count, width)
    shape = [1 if d in dims else size for d, size in enumerate(nodes.shape) if keepdim or d in kept]
    return _Numbers(torch.tensor([graph.sum(row) for row in rows.tolist()], dtype=torch.long).view(shape))


def _mean(graph: Graph, x: _Numbers, dim: Any = None, keepdim: bool = False) -> _Numbers:
    total = _sum(graph, x, dim, keepdim)
    return _binary("multiply")(graph, total, total.nodes.numel() / x.nodes.numel())


def _norm(graph: Graph, x: Any, order: Any = 2.0, dim: Any = None, keepdim: bool = False) -> _Numbers:
    if order != 2.0:
        raise InvalidInput(f"compiled code holds norms of order 2 only, not {order}; give compile=False.")
    return _elementwise(graph, lambda total: _root(graph, total), _sum(graph, _power(graph, x, 2.0), dim, keepdim))


def _root(graph: Graph, total: int) -> int:
    """sqrt, with derivative 0 at 0, as norms and distances of torch have it."""
    positive = graph.apply("less", ZERO, total)
    return graph.apply("choose", positive, graph.apply("sqrt", graph.apply("choose", positive, total, ONE)), ZERO)


def _distances(graph: Graph, x: Any, y: Any, order: float = 2.0, mode: Any = None) -> _Numbers:  # cdist of order 2
    if order != 2.0:
        raise InvalidInput(f"compiled code holds distances of order 2 only, not {order}; give compile=False.")
    left, right = _numbers(graph, x).nodes.tolist(), _numbers(graph, y).nodes.tolist()

    def one(a: list[int], b: list[int]) -> int:
        apart = [graph.apply("subtract", *pair) for pair in zip(a, b, strict=True)]
        return graph.apply("absolute", apart[0]) if len(apart) == 1 else _root(graph, graph.dot(apart, apart))

    return _Numbers(torch.tensor([[one(a, b) for b in right] for a in left], dtype=torch.long))


def _product(graph: Graph, x: Any, y: Any) -> _Numbers:  # mm and bmm
    left, right = _numbers(graph, x).nodes, _numbers(graph, y).nodes
    shape = (*left.shape[:-1], right.shape[-1])
    count = math.prod(left.shape[:-2])
    if left.numel() and bool((left[..., -1, 0] == ZERO).all()):  # sums of what follows share terms from the end on
        left, right = left.flip(-1), right.flip(-2)
    pairs = zip(*(x.reshape(count, *x.shape[-2:]).tolist() for x in (left, right.mT)), strict=True)
    results = [graph.dot(row, column) for rows, columns in pairs for row in rows for column in columns]
    return _Numbers(torch.tensor(results, dtype=torch.long).view(shape))


def _added_product(graph: Graph, bias: Any, x: Any, y: Any, beta: Any = 1.0, alpha: Any = 1.0) -> _Numbers:
    """addmm and baddbmm."""
    times = _binary("multiply")
    return _binary("add")(graph, times(graph, _product(graph, x, y), float(alpha)), times(graph, bias, float(beta)))


HANDLERS: dict[str, Callable[..., Any]] = {
    "full_like": lambda graph, x, value: _Numbers(torch.full_like(x.nodes, graph.constant(value))),
    "constant_pad_nd": lambda graph, x, pad, y=0.0: _Numbers(torch.constant_pad_nd(x.nodes, pad, graph.constant(y))),
    # the decomposition that torch has of it takes a second to import what it needs
    "addcmul": lambda graph, x, y, z, value=1.0: _binary("add")(graph, x, _binary("multiply")(graph, y, z), value),
    **{name: _binary(NAMES[name]) for name in ("add", "sub", "mul", "div")},
    "rsub": lambda graph, x, y, alpha=1.0: _binary("subtract")(graph, y, _binary("multiply")(graph, x, float(alpha))),
    "atan2": _binary("atan2"),
    "lt": _binary("less"),
    "le": _binary("at_most"),
    "gt": _binary("less", swapped=True),
    "ge": _binary("at_most", swapped=True),
    "eq": _binary("equal"),
    "ne": lambda graph, x, y: _negated(graph, _binary("equal")(graph, x, y)),
    **dict.fromkeys(("logical_not", "bitwise_not"), _negated),
    **dict.fromkeys(("logical_and", "bitwise_and"), _binary("multiply")),
    **dict.fromkeys(
        ("logical_or", "bitwise_or"),
        lambda graph, x, y: _elementwise(graph, lambda a, b: graph.apply("choose", a, ONE, b), x, y),
    ),
    "where": lambda graph, m, x, y: _elementwise(graph, lambda *nodes: graph.apply("choose", *nodes), m, x, y),
    "reciprocal": lambda graph, x: _binary("divide")(graph, 1.0, x),
    "rsqrt": lambda graph, x: _power(graph, x, -0.5),
    "sign": lambda graph, x: _binary("subtract")(graph, HANDLERS["gt"](graph, x, 0.0), HANDLERS["lt"](graph, x, 0.0)),
    "pow": _power,
    **dict.fromkeys(("clamp", "clamp_min", "maximum"), _clamp),
    **dict.fromkeys(("clamp_max", "minimum"), lambda graph, x, high: _clamp(graph, x, None, high)),
    "sum": _sum,
    "mean": _mean,
    "linalg_vector_norm": _norm,
    "_cdist_forward": _distances,
    **dict.fromkeys(("mm", "bmm"), _product),
    "mv": lambda graph, x, y: _Numbers(_product(graph, x, _Numbers(_numbers(graph, y).nodes[:, None])).nodes[:, 0]),
    "dot": lambda graph, x, y: _sum(graph, _binary("multiply")(graph, x, y)),
    **dict.fromkeys(("addmm", "baddbmm"), _added_product),
}
