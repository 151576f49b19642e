"""Tapes compute what torch computes: values, Jacobians, and small linear algebra."""

import math

import numpy as np
import pytest
import torch

from forcegp.codegen.branch_free_linalg import StraightLineAlgebra, cholesky, pseudo_inverse, solve_lower
from forcegp.codegen.cpp_library import cpp_library
from forcegp.codegen.tape import BINARY, UNARY, Tape
from forcegp.codegen.tape_machine import TapeMachine
from forcegp.codegen.tape_tracing import trace
from forcegp.errors import CompilerError, InvalidInput
from forcegp.inference.compiled_kernels import CompiledSums
from forcegp.inference.prepared_kernels import SharedCenters


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def everything(x: torch.Tensor, y: torch.Tensor) -> list[torch.Tensor]:
    """Every function that a tape holds, inside the domains of all of them for |x| and |y| below 1."""
    inside, positive = 0.9 * torch.tanh(x), torch.exp(y)
    table = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)
    place = (torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64) < x.detach()[..., None]).sum(-1).clamp(1, 3)
    weights = torch.tensor([[0.0, 1.0, 2.0], [3.0, 0.0, -1.0]], dtype=torch.float64)
    return [
        inside.asin() + inside.acos() + x.sin() * y.cos() + x.tan() + x.atan() - x.asinh(),
        positive.log() + positive.sqrt() + positive.rsqrt() + positive.reciprocal(),
        torch.log1p(positive) + torch.expm1(x) + x.sinh() - y.cosh() + torch.erf(x) + torch.sigmoid(y),
        x.abs() + y.sign() * x + torch.atan2(x, positive) + x**2 + x**3 + positive**-1.0 + positive**1.7,
        torch.where((x < y) | (x > 2.0 * y), x, y * x) + torch.where(~(x <= 0.0) & (y != 0.1), x.square(), y),
        x.clamp(-0.3, 0.4) + torch.maximum(x, y) + torch.minimum(x, 2.0 * y) + x.clamp_min(0.1),
        (x @ weights.mT).sum(-1, keepdim=True) + torch.linalg.vector_norm(y, dim=-1, keepdim=True) + x.mean(),
        torch.cat([x[:, :2], y.flip(-1)], dim=-1)[:, 1:4] - torch.stack([x, y]).sum((0, 1)),
        table[place] * x + torch.linalg.cross(x, y) + torch.nn.functional.pad(x[:, :1], (0, 2), value=0.5) * y,
        torch.diag_embed(x).flatten(1) * torch.full_like(y, 2.0).repeat(1, 3),
    ]


def test_every_operation_and_its_derivative():
    x, y = 0.3 * normal(1, 3), 0.3 * normal(1, 3, seed=1)
    program, shapes = trace(everything, (x, y))
    assert [tuple(shape) for shape in shapes] == [tuple(part.shape) for part in everything(x, y)]
    machine = TapeMachine(program)
    rows = 0.3 * normal(70, 6, seed=2)  # more than two batches, the last one not full

    def plain(row: torch.Tensor) -> torch.Tensor:
        return torch.cat([part.flatten() for part in everything(row[None, :3], row[None, 3:])])

    expected = torch.stack([plain(row) for row in rows])
    assert float((machine(rows) - expected).abs().max()) < 1e-13
    assert float((torch.cat([machine(row[None]) for row in rows]) - expected).abs().max()) < 1e-13
    slopes = torch.stack([torch.autograd.functional.jacobian(plain, row) for row in rows[:5]])
    values, found = machine.with_jacobian(rows[:5])
    assert float((values - expected[:5]).abs().max()) < 1e-13
    assert float((found - slopes).abs().max()) < 1e-12


def test_wide_functions_have_all_their_derivatives():
    A = normal(2, 60)
    machine = TapeMachine(trace(lambda x: [(x.sin() @ A.mT).exp()], (normal(1, 60),))[0])
    assert torch.autograd.gradcheck(machine, normal(2, 60, seed=3).requires_grad_())


def test_what_is_known_is_not_recorded():
    tape = Tape(2)
    x, y = tape.inputs
    assert tape.apply("multiply", x, tape.constant(0.0)) == tape.constant(0.0)
    assert tape.apply("add", tape.constant(0.0), y) == y
    assert tape.apply("add", x, y) == tape.apply("add", y, x)
    assert tape.value(tape.apply("sqrt", tape.constant(2.0))) == math.sqrt(2.0)
    assert math.isnan(tape.value(tape.apply("log", tape.constant(-1.0))))
    assert tape.apply("negate", tape.apply("negate", x)) == x
    assert tape.apply("choose", tape.constant(1.0), x, y) == x
    total = tape.sum([tape.apply("multiply", x, y), x, y])
    program = tape.program([total])
    assert len(program.instructions) == 2  # x y + x in one, + y
    assert TapeMachine(program).values(torch.tensor([[2.0, 3.0]], dtype=torch.float64)).tolist() == [[11.0]]


@pytest.mark.parametrize("operation", [*UNARY, *BINARY])
def test_constants_are_folded_as_the_machine_computes(operation: str):
    operands = [0.3, 0.7][: 1 if operation in UNARY else 2]
    tape = Tape(len(operands))
    machine = TapeMachine(tape.program([tape.apply(operation, *tape.inputs)]))
    folded = tape.value(tape.apply(operation, *(tape.constant(x) for x in operands)))
    assert float(machine.values(torch.tensor([operands], dtype=torch.float64))) == pytest.approx(folded, rel=1e-15)


def test_an_index_that_no_tape_holds_is_named():
    with pytest.raises(InvalidInput, match=r"operation aten\.sort.*compile=False"):
        trace(lambda x: [x.sort().values], (normal(1, 3),))
    with pytest.raises(InvalidInput, match="order 2 only"):
        trace(lambda x: [torch.linalg.vector_norm(x, 1, dim=-1)], (normal(1, 3),))


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


def test_derivatives_of_the_pseudo_inverse_hold_where_rows_are_orthogonal_and_equally_long():
    """There the rotations have none: those of what they leave must be right."""
    A = torch.eye(3, 7, dtype=torch.float64)
    direction = normal(3, 7)
    expected = torch.autograd.functional.jvp(torch.linalg.pinv, A, direction)[1]
    found = torch.autograd.functional.jvp(lambda B: pseudo_inverse(B, 1e-9), A, direction)[1]
    assert float((found - expected).abs().max()) < 1e-13


def test_factor_and_solution_are_those_of_torch():
    G, right = normal(3, 6, 6), normal(3, 6, 2, seed=1)
    M = G @ G.mT + torch.eye(6, dtype=torch.float64)
    L = torch.linalg.cholesky(M)
    assert float((cholesky(M) - L).abs().max()) < 1e-13
    assert float((solve_lower(L, right) - torch.linalg.solve_triangular(L, right, upper=False)).abs().max()) < 1e-12
    with StraightLineAlgebra():
        assert torch.equal(torch.linalg.cholesky(M), cholesky(M))
    assert bool(torch.isnan(cholesky(-M)).any())


@pytest.mark.parametrize(("latents", "count"), [(1, 1), (3, 34), (9, 37), (7, 40)])
def test_compiled_sums_are_those_of_torch(latents: int, count: int):
    centers, weights = normal(count, 4), normal(latents, count, seed=1)
    scales = [(0.3 + normal(4, seed=k).abs(), torch.tensor(0.5 + k, dtype=torch.float64)) for k in range(latents)]
    group = SharedCenters.of(tuple(range(latents)), centers, scales)
    far = torch.cat([normal(6, 4, seed=5), 200.0 * normal(2, 4, seed=6)])  # the kernel is 0 there
    inputs = group.inputs([far] * latents)
    expected = torch.stack(
        [s * torch.exp(-0.5 * ((far[:, None] - centers) / length).square().sum(-1)) for length, s in scales], dim=1
    )
    mean, cross = CompiledSums(group.centers, group.own, weights)(inputs, True)
    assert float((cross - expected).abs().max()) < 1e-12
    assert float((cross - group.cross(inputs)).abs().max()) < 1e-12
    assert float((mean - (expected * weights).sum(-1)).abs().max()) < 1e-11
    assert bool((cross[-2:] == 0.0).all())
    assert float((group.diagonal(inputs)[0] - torch.stack([s for _, s in scales])).abs().max()) == 0.0


def test_no_compiler_is_an_error_with_a_remedy(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(CompilerError, match=r"no-such-compiler.*CXX.*compile=False"):
        cpp_library("// nothing that was compiled before", "values")
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(CompilerError, match="compiler failed"):
        cpp_library("// nor this", "values")


def test_programs_are_small_arrays():
    program, _ = trace(lambda x: [x * 2.0 + 1.0], (normal(1, 2),))
    assert program.instructions.dtype == np.int32
    assert sorted(program.constants) == [1.0, 2.0]
    assert program.outputs.shape == (2,)
