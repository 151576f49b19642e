"""Graphs compute what torch computes: values, derivatives, as C for one state and for several; small linear algebra."""

import math

import numpy as np
import pytest
import torch

from forcegp.codegen import library as programs
from forcegp.codegen.c_writer import Program, write_function, write_program
from forcegp.codegen.graph import BINARY, FUNCTIONS, ONE, UNARY, ZERO, Copier, Graph, interpreted, jacobian
from forcegp.codegen.tracing import StraightLineAlgebra, cholesky, pseudo_inverse, solve_lower, trace
from forcegp.errors import InvalidInput


def evaluated(graph, outputs, inputs):
    with np.errstate(all="ignore"):
        return [np.asarray(x, dtype=np.float64) for x in interpreted(graph, outputs, inputs, FUNCTIONS)]


@pytest.fixture(params=[1, "here"], ids=["C99", "vectors"])
def lanes(request) -> int:
    return programs.vector_unit()[0] if request.param == "here" else request.param


@pytest.fixture
def compiled(tmp_path, lanes):
    """A program as a function of rows, for one double or for vectors."""

    def build(program: Program) -> programs.RowFunction:
        strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-fPIC", "-shared")
        options = strict if lanes == 1 else (*programs.OPTIONS, *programs.vector_unit()[1])
        library = programs.compile_library(write_program(program, lanes, 60), options, tmp_path / "x.so", "evaluate")
        return programs.RowFunction(library, len(program.inputs), [len(x) for x in program.outputs.values()])

    return build


def rows_of(function: programs.RowFunction, *inputs: torch.Tensor) -> list[torch.Tensor]:
    outputs = [torch.empty(len(inputs[0]), size, dtype=torch.float64) for size in function.outputs]
    assert function.rows(inputs, outputs) == 0
    return outputs


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def everything(x: torch.Tensor, y: torch.Tensor) -> list[torch.Tensor]:
    """Every function that a graph holds, inside the domains of all of them for |x| and |y| below 1."""
    inside, positive = 0.9 * torch.tanh(x), torch.exp(y)
    table = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)
    place = (torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64) < x.detach()[..., None]).sum(-1).clamp(1, 3)
    weights = torch.tensor([[0.0, 1.0, 2.0], [3.0, 0.0, -1.0]], dtype=torch.float64)
    return [
        inside + x.sin() * y.cos() + x.tan() - x.asinh(),
        positive.log() + positive.sqrt() + positive.rsqrt() + positive.reciprocal(),
        torch.log1p(positive) + torch.expm1(x) - y.tanh(),
        x.abs() + y.sign() * x + torch.atan2(x, positive) + x**2 + x**3 + positive**-1.0 + positive**1.7,
        torch.where((x < y) | (x > 2.0 * y), x, y * x) + torch.where(~(x <= 0.0) & (y != 0.1), x.square(), y),
        x.clamp(-0.3, 0.4) + torch.maximum(x, y) + torch.minimum(x, 2.0 * y) + x.clamp_min(0.1),
        (x @ weights.mT).sum(-1, keepdim=True) + torch.linalg.vector_norm(y, dim=-1, keepdim=True) + x.mean(),
        torch.cat([x[:, :2], y.flip(-1)], dim=-1)[:, 1:4] - torch.stack([x, y]).sum((0, 1)),
        table[place] * x + torch.linalg.cross(x, y) + torch.nn.functional.pad(x[:, :1], (0, 2), value=0.5) * y,
        torch.diag_embed(x).flatten(1) * torch.full_like(y, 2.0).repeat(1, 3),
    ]


def flat(found: list[torch.Tensor]) -> list[int]:
    return [node for part in found for node in part.flatten().tolist()]


def test_every_operation_and_its_derivative(compiled):
    x, y = 0.3 * normal(1, 3), 0.3 * normal(1, 3, seed=1)
    graph, found = trace(everything, (x, y))
    assert [tuple(part.shape) for part in found] == [tuple(part.shape) for part in everything(x, y)]
    outputs = flat(found)
    slopes = [node for row in jacobian(graph, outputs, graph.inputs) for node in row]
    function = compiled(Program(graph, {"x": 6}, {"y": outputs, "J": slopes}))
    rows = 0.3 * normal(19, 6, seed=2)  # the last vector is not full

    def plain(row: torch.Tensor) -> torch.Tensor:
        return torch.cat([part.flatten() for part in everything(row[None, :3], row[None, 3:])])

    expected = torch.stack([plain(row) for row in rows])
    values, J = rows_of(function, rows)
    assert float((values - expected).abs().max()) < 1e-13
    assert float((function.single(rows[4])[1][0] - expected[4]).abs().max()) < 1e-13
    with_numpy = torch.tensor(np.stack(np.broadcast_arrays(*evaluated(graph, outputs, list(rows.mT.numpy()))), -1))
    assert float((with_numpy - expected).abs().max()) < 1e-13
    theirs = torch.stack([torch.autograd.functional.jacobian(plain, row) for row in rows])
    assert float((J.view(theirs.shape) - theirs).abs().max()) < 1e-12


def test_functions_far_from_where_they_are_easy(compiled):
    """Signs, infinities, large arguments, and what nearly cancels: as libm has them."""
    names = ("sin", "cos", "exp", "log", "log1p", "expm1", "tanh", "asinh", "sqrt", "absolute")
    graph = Graph(1)
    outputs = [graph.apply(name, graph.inputs[0]) for name in names]
    x = torch.tensor([-1e-300, 1e-9, -3e-5, 0.3, -0.6, 1.1, 30.0, -40.0, 700.0, -745.0, 1e5, 3e7, -1e17, 1e200])
    x, function = x.double()[:, None], compiled(Program(graph, {"x": 1}, {"y": outputs}))
    values = torch.empty(len(x), len(names), dtype=torch.float64)
    function.rows([x], [values])
    theirs = torch.cat([getattr(torch, {"absolute": "abs"}.get(name, name))(x) for name in names], dim=1)
    torch.testing.assert_close(values, theirs, rtol=4e-15, atol=1e-307, equal_nan=True)


def test_what_is_known_is_not_recorded():
    graph = Graph(2)
    x, y = graph.inputs
    apply, constant = graph.apply, graph.constant
    assert apply("multiply", x, ZERO) == ZERO
    assert apply("add", ZERO, y) == y
    assert apply("add", x, y) == apply("add", y, x)
    assert apply("subtract", x, x) == ZERO
    assert graph.value(apply("sqrt", constant(2.0))) == math.sqrt(2.0)
    assert math.isnan(graph.value(apply("log", constant(-1.0))))
    assert apply("negate", apply("negate", x)) == x
    assert apply("choose", ONE, x, y) == x
    assert apply("divide", x, constant(4.0)) == apply("multiply", x, constant(0.25))
    assert graph.value(graph.look_up([1.0, 5.0], ONE)) == 5.0
    assert len(graph.needed([apply("add", apply("multiply", x, y), x)])) == 4


def test_constants_are_folded_as_the_machine_computes(compiled):
    operands, graph, counts = (0.3, 0.7), Graph(2), {**dict.fromkeys(UNARY, 1), **dict.fromkeys(BINARY, 2)}
    folded = [graph.value(graph.apply(name, *map(graph.constant, operands[:n]))) for name, n in counts.items()]
    outputs = [graph.apply(name, *graph.inputs[:n]) for name, n in counts.items()]
    found = compiled(Program(graph, {"x": 2}, {"y": outputs})).single(torch.tensor(operands, dtype=torch.float64))[1][0]
    np.testing.assert_allclose(found, folded, rtol=1e-15)


def test_programs_report_what_is_wrong_with_their_states(compiled):
    graph = Graph(1)
    (x,) = graph.inputs
    function = compiled(Program(graph, {"x": 1}, {"y": [graph.apply("log", x)]}, [graph.apply("subtract", ONE, x)]))

    def bits(value: float) -> int:
        return function.single(torch.tensor([value], dtype=torch.float64))[0]

    assert (bits(0.5), bits(2.0)) == (0, programs.NOT_POSITIVE)
    assert bits(-1.0) == programs.RESULT_NOT_FINITE
    assert bits(math.nan) & programs.NOT_FINITE


def test_an_index_that_no_graph_holds_is_named():
    with pytest.raises(InvalidInput, match=r"operation aten\.sort.*compile=False"):
        trace(lambda x: [x.sort().values], (normal(1, 3),))
    with pytest.raises(InvalidInput, match="order 2 only"):
        trace(lambda x: [torch.linalg.vector_norm(x, 1, dim=-1)], (normal(1, 3),))
    graph = Graph(1)
    called = graph.call("f", graph.inputs, 1)
    with pytest.raises(InvalidInput, match="gives no derivatives"):
        jacobian(graph, called, graph.inputs)
    ((slope,),) = jacobian(graph, graph.call("g", graph.inputs, 1, slopes={(0, 0): 1}), graph.inputs)
    assert graph.nodes[slope][0] == "output"
    assert graph.nodes[slope][2] == 1  # of g, beyond its one value


@pytest.mark.parametrize("count", [1, 4])
def test_distances_have_no_slope_where_they_vanish(count):
    graph, (found,) = trace(
        lambda x, y: [torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")],
        (normal(1, count), normal(1, count)),
    )
    slopes = jacobian(graph, flat([found]), graph.inputs)[0]
    assert [float(x[0]) for x in evaluated(graph, slopes, [np.array([0.3])] * (2 * count))] == [0.0] * (2 * count)
    assert evaluated(graph, flat([found]), [np.array([float(k**2)]) for k in range(2 * count)])[0] == math.sqrt(
        sum((k**2 - (k + count) ** 2) ** 2 for k in range(count))
    )


@pytest.mark.parametrize("rows", [1, 2, 3, 5])
@pytest.mark.parametrize("case", ["full rank", "twice the same row", "a sum of rows"])
def test_the_pseudo_inverse_is_that_of_torch(rows: int, case: str):
    A = normal(4, rows, 7)
    if case == "twice the same row":
        A[:, -1] = A[:, 0]
    if case == "a sum of rows":
        A[:, -1] = 2.0 * A[:, :-1].sum(1) if rows > 1 else A[:, -1]
    found, expected = pseudo_inverse(A, 1e-9), torch.linalg.pinv(A, rtol=1e-9)
    assert float((found - expected).abs().max()) < 1e-13 * (1.0 + float(expected.abs().max()))


@pytest.mark.parametrize("turn", [0.3, 1e-3, 1e-6, 1e-8])
def test_the_pseudo_inverse_of_redundant_rows_that_nearly_depend_on_each_other(turn: float):
    """Nine rows of a body held by three points, nearly along the axes of the world: six are independent."""
    draw = torch.Generator().manual_seed(3)
    axes = torch.linalg.matrix_exp(turn * torch.tensor([[0.0, -1.0, 0.4], [1.0, 0.0, -0.7], [-0.4, 0.7, 0.0]]).double())
    x, y, z = (0.1 * axes[:, :2]).mT.unbind(-1)
    arms = torch.stack(
        [torch.stack([0 * x, -z, y], -1), torch.stack([z, 0 * x, -x], -1), torch.stack([-y, x, 0 * x], -1)], -1
    )
    one = torch.eye(3).double()
    body = torch.cat([torch.cat([one, 0 * one], 1), *(torch.cat([one, arm], 1) for arm in arms)])
    A = body @ torch.randn(5, 6, 12, generator=draw).double()
    found, expected = pseudo_inverse(A, 1e-9), torch.linalg.pinv(A, rtol=1e-9)
    assert float((found - expected).abs().max()) < 1e-11 * float(expected.abs().max())  # condition of A: some 1e3


def test_factor_and_solution_are_those_of_torch():
    G, right = normal(3, 6, 6), normal(3, 6, 2, seed=1)
    M = G @ G.mT + torch.eye(6, dtype=torch.float64)
    L = torch.linalg.cholesky(M)
    assert float((cholesky(M) - L).abs().max()) < 1e-13
    assert float((solve_lower(L, right) - torch.linalg.solve_triangular(L, right, upper=False)).abs().max()) < 1e-12
    with StraightLineAlgebra():
        assert torch.equal(torch.linalg.cholesky(M), cholesky(M))
    assert bool(torch.isnan(cholesky(-M)).any())


def test_outputs_of_a_call_stand_where_it_does():
    """Though there are more of them than statements in a part; and the same after a copy to another graph."""
    graph = Graph(1)
    first = graph.apply("sin", graph.inputs[0])
    outputs, made = graph.call("f", [first], 11, slopes={(0, 0): 11}), Graph(1)
    copied = Copier(made, graph, dict(zip(graph.inputs, made.inputs, strict=True)))([*outputs, first])
    for of, nodes in ((graph, [*outputs, first]), (made, copied)):
        text = write_function("part", of, [of.sum(nodes)], 1, ["f"], most=3)
        parts = [part for part in text.split("static APART void part_") if "c4[" in part]
        assert len(parts) == 1
        assert "real c4[12]" in parts[0]
        assert all(f"= c4[{k}];" in parts[0] for k in range(11))
