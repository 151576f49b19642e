"""The predictor says what `predict` says, faster; its compressed covariance is never below the exact one."""

import pickle

import pytest
import torch
from tests.posterior.arm import arm_model, quick_fit
from torch.autograd import forward_ad

from forcegp.errors import InvalidInput, NumericalError, NumericalWarning
from forcegp.forces import ContactFriction, JointFriction, ToolForces
from forcegp.mechanics import Contact, ImplicitSurface, Plane, Sphere
from forcegp.posterior import Posterior, Predictor, preparation

TIP = (0.0, 0.0, 0.2)
CONTACTS = {
    "none": [],
    "sphere": [Contact("hand", TIP, Sphere((0.0, 0.0, -1.0), 1.5))],
    "implicit": [Contact("hand", TIP, ImplicitSurface(lambda p: p[2] - 0.3 * torch.sin(2 * p[0]) - 0.1 * p[1] ** 2))],
    "two": [
        Contact("hand", TIP, Plane((0.0, 0.0, 1.0), 0.4)),
        Contact("hand", (0.0, 0.1, 0.2), Sphere((0.0, 0.0, -1.0), 1.5)),
    ],
    "redundant": [Contact("hand", TIP, Plane((0.2, 0.0, 1.0), 0.4))] * 2,
}


@pytest.fixture(scope="module")
def means(posterior) -> Predictor:
    return posterior.predictor(covariance="none")


@pytest.fixture(scope="module")
def compressed(posterior) -> Predictor:
    return posterior.predictor()


def assert_close(found: torch.Tensor, expected: torch.Tensor, tolerance: float = 1e-10):
    assert found.shape == expected.shape
    assert float((found - expected).abs().max()) <= tolerance * (1e-300 + float(expected.abs().max()))


def check(posterior: Posterior, states: tuple[torch.Tensor, ...]):
    """Mean, exact covariance and derivatives are those of `predict`, for one state and for several."""
    predictor, expected = posterior.predictor(covariance="exact"), posterior.predict(*states)
    mean, covariance = predictor(*states)
    assert_close(mean, expected.mean)
    assert_close(predictor.mean(*states), expected.mean)
    assert_close(covariance, expected.covariance, 1e-9)
    alone = tuple(x[2] for x in states)
    assert_close(predictor.mean(*alone), expected.mean[2])
    assert_close(predictor(*alone)[1], expected.covariance[2], 1e-9)
    derivatives = torch.autograd.functional.jacobian(
        lambda *x: posterior.predict(*(y[None] for y in x), covariance=False).mean[0], alone
    )
    for linear in (predictor.linearize(*alone), [part[2] for part in predictor.linearize(*states)]):
        assert_close(linear[0], expected.mean[2])
        for found, derivative in zip(linear[1:], derivatives, strict=True):
            assert float((found - derivative).abs().max()) <= 1e-9 * (1.0 + float(derivative.abs().max()))


@pytest.mark.parametrize(
    "contacts",
    ["two", *(pytest.param(k, marks=pytest.mark.nightly) for k in ("redundant", "none", "sphere", "implicit"))],
)
def test_it_is_predict_under_any_contacts(posterior, states, contacts: str):
    check(posterior.with_contacts(CONTACTS[contacts]), states)


@pytest.mark.parametrize(
    "model",
    [
        arm_model().with_forces(JointFriction(), ContactFriction(load=True, expected=0.2)),
        pytest.param(arm_model().with_forces(ToolForces(inputs=("velocity", "position"))), marks=pytest.mark.nightly),
        arm_model(),
        pytest.param(arm_model().with_forces(JointFriction()).without_mean(), marks=pytest.mark.nightly),
    ],
    ids=["friction under load", "tool forces", "no forces", "zero mean"],
)
def test_it_is_predict_with_any_prior(states, model):
    check(quick_fit(model), states)


def test_gradients_of_mean_and_covariance_are_those_of_torch(posterior, states, monkeypatch):
    monkeypatch.setattr(preparation, "TOLERANCE", 100.0)
    compiled, eager = (posterior.predictor(compile=compile) for compile in (True, False))
    assert compiled.rank == eager.rank > 1

    def gradients(predictor) -> tuple[torch.Tensor, ...]:
        x = tuple(part.clone().requires_grad_() for part in states)
        mean, covariance = predictor(*x)
        return torch.autograd.grad(
            mean.square().mean() + covariance.diagonal(dim1=1, dim2=2).sqrt().sum() + covariance[:, 0, 1].sum(), x
        )

    for found, expected in zip(gradients(compiled), gradients(eager), strict=True):
        assert_close(found, expected, 1e-6)
    for found, expected in zip(compiled.linearize(*states), eager.linearize(*states), strict=True):
        assert_close(found, expected)


def test_the_compressed_covariance_is_never_below_the_exact_one(posterior, states, monkeypatch):
    exact = posterior.predict(*states).covariance
    monkeypatch.setattr(preparation, "TOLERANCE", 1e-9)
    for rank in (1, 5, 20):
        monkeypatch.setattr(preparation, "LARGEST_RANK", rank)
        with pytest.warns(NumericalWarning, match=f"rank {rank} makes"):
            predictor = posterior.predictor(compile=False)
        assert predictor.rank == rank
        excess = predictor(*states)[1] - exact
        assert float(torch.linalg.eigvalsh(excess).min()) > -1e-9 * float(exact.abs().max())
    assert float(excess.diagonal(dim1=1, dim2=2).max()) > 1e-6 * float(exact.abs().max())  # it is a compression


def test_the_rank_keeps_the_tolerance_and_no_more(posterior, monkeypatch):
    tight = posterior.predictor(compile=False)
    monkeypatch.setattr(preparation, "TOLERANCE", 100.0)
    loose = posterior.predictor(compile=False)
    assert loose.rank < tight.rank <= 2 * 30
    assert 0.01 < float(loose.inflation.max()) <= 100.0
    assert float(tight.inflation.max()) <= 0.01
    rows = posterior.training
    compressed = tight(rows.q, rows.v, rows.u)[1].diagonal(dim1=1, dim2=2)
    ratio = (compressed / posterior.predict(rows.q, rows.v, rows.u).variance).sqrt()
    assert 1.0 - 1e-6 < float(ratio.min()) <= float(ratio.max()) < 1.02


def test_a_copy_in_another_process_is_the_same(compressed, states):
    copied = pickle.loads(pickle.dumps(compressed))
    for found, expected in zip(copied(*states), compressed(*states), strict=True):
        assert torch.equal(found, expected)


TRANSFORMS = {
    "jacrev": lambda f, x: torch.func.jacrev(f)(x),
    "grad": lambda f, x: torch.stack([torch.func.grad(lambda y, i=i: f(y)[i])(x) for i in range(3)]),
    "vjp": lambda f, x: torch.stack([torch.func.vjp(f, x)[1](row)[0] for row in torch.eye(3, dtype=x.dtype)]),
    "jacfwd": lambda f, x: torch.func.jacfwd(f)(x),
    "jvp": lambda f, x: torch.stack([torch.func.jvp(f, (x,), (row,))[1] for row in torch.eye(3, dtype=x.dtype)], 1),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_transforms_are_refused_by_code_and_taken_by_torch(posterior, means, compressed, states, transform):
    q, v, u = (x[0] for x in states)
    take, refused = TRANSFORMS[transform], r"does not support transforms of torch\.func .*linearize.*compile=False"
    for function in (means.mean, compressed, means.linearize):
        with pytest.raises(InvalidInput, match=refused):
            take(lambda y, f=function: f(y, v, u), q)
    eager = posterior.predictor(covariance="none", compile=False)
    assert_close(take(lambda y: eager.mean(y, v, u), q), means.linearize(q, v, u).da_dq)
    with pytest.raises(InvalidInput, match="linearize does not support transforms"):  # it would give zeros
        take(lambda y: eager.linearize(y, v, u).a, q)


def test_forward_mode_derivatives_are_not_lost(posterior, means, states):
    q, v, u = (x[0] for x in states)
    direction = torch.linspace(-1.0, 1.0, 3, dtype=torch.float64)
    eager = posterior.predictor(covariance="none", compile=False)
    with forward_ad.dual_level():
        assert_close(means.mean(q, v, u), eager.mean(q, v, u))  # numbers alone are taken as ever
        x = forward_ad.make_dual(q, direction)
        for function in (means.mean, means.linearize):
            with pytest.raises(InvalidInput, match=r"forward-mode .*linearize"):
                function(x, v, u)
        with pytest.raises(InvalidInput, match="linearize does not support forward-mode"):
            eager.linearize(x, v, u)
        tangent = forward_ad.unpack_dual(eager.mean(x, v, u)).tangent
    assert_close(tangent, means.linearize(q, v, u).da_dq @ direction)


def test_errors_name_the_remedy(posterior, means, states):
    q, v, u = states
    with pytest.raises(InvalidInput, match=r"u \(5, 2\); give q \(\.\.\., 3\)"):
        means.mean(q, v, u[:, :2])
    with pytest.raises(InvalidInput, match=r"v \(3,\)"):
        means.mean(q, v[0], u)
    with pytest.raises(InvalidInput, match="not finite"):
        means.mean(q, v * float("nan"), u)
    with pytest.raises(InvalidInput, match=r"device .*cpu"):
        means.mean(q.to("meta"), v, u)
    with pytest.raises(InvalidInput, match="covariance='compressed' or 'exact'"):
        means(q, v, u)
    with pytest.raises(InvalidInput, match=r"'dense'.*'auto', 'compressed', 'exact', 'none'"):
        posterior.predictor(covariance="dense")
    with pytest.raises(NumericalError, match="not finite"):
        means.mean(q, v * 1e200, u)


def test_operations_that_no_tape_holds_are_named(posterior, states):
    surface = ImplicitSurface(lambda p: p[2] + torch.special.bessel_j0(p[0]))
    bent = posterior.with_contacts([Contact("hand", TIP, surface)])
    with pytest.raises(InvalidInput, match=r"operation aten.*bessel_j.*compile=False"):
        bent.predictor(covariance="none")
    assert_close(bent.predictor(covariance="none", compile=False).mean(*states), bent.predict(*states).mean)


@pytest.mark.nightly
def test_it_takes_what_another_engine_knows(states):
    posterior = quick_fit(arm_model().with_forces(JointFriction()), engine="inducing")
    check(posterior, states)
    with pytest.raises(InvalidInput, match=r"InducingPosterior .*covariance='exact'"):
        posterior.predictor(covariance="compressed")
    predictor = posterior.predictor()
    assert (predictor.kind, predictor.rank, predictor.inflation) == ("exact", None, None)
    assert_close(predictor(*states)[1], posterior.predict(*states).covariance, 1e-9)
