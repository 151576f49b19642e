"""Jobs of the experiments on force priors: which rows they take, and every score against direct computation."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.force_priors import jobs as force_jobs
from tests.benchmarks.oracle import Tool
from tests.benchmarks.stored_jobs import keep

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import ContactFriction, JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.jobs import JobStore
from forcegp.posterior import load_posterior

OPTIONS = OptimizerOptions(iterations=5)
TRAIN, TEST = "force-data/train", "force-data/test"


@pytest.fixture(scope="module")
def rubbing():
    """2 s with Stribeck friction at tool and joints, and a fit of both to every 20th row."""
    pytest.importorskip("pybullet")
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

    data = simulate_kuka_surface(KukaSurfaceConfig(seconds=2, seed=3, friction="stribeck", joint_friction="stribeck"))
    prior = JointFriction(), ContactFriction(load=True, expected=0.3)
    posterior = fit(data.model.with_forces(prior), data.rows(slice(0, None, 20)), restarts=1, options=OPTIONS)
    return posterior, data.rows(slice(7, None, 16))


@pytest.fixture
def results(tmp_path):
    return JobStore.open(tmp_path / "out", "a test", {})


def stored(results, **data):
    for name, rows in data.items():
        keep(results, f"force-data/{name}", {}, {}, lambda folder, rows=rows: rows.save(folder / force_jobs.FILE))


def fit_spec(**changes):
    spec = {"train": TRAIN, "tests": {"there": TEST}, "prior": "gp:tool-friction", "mean": "analytical", "points": 12}
    return spec | {"region": False, "seed": 0, "restarts": 1, "iterations": 2, "tolerance": 1e-6} | changes


def test_laws_that_were_identified_count_in_the_scores():
    """Scores move a model to the contacts of the test trajectory; the friction that it identified goes with it."""
    pytest.importorskip("pybullet")
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

    config = KukaSurfaceConfig(seconds=3, seed=3, surface="none", joint_friction="coulomb")
    rows = simulate_kuka_surface(config).rows(slice(0, None, 20))
    errors = {}
    for prior in (force_jobs.KNOWN_PHYSICS, force_jobs.LAWS):
        model = force_jobs.fitted(fit_spec(prior=prior, iterations=60), rows)
        errors[prior] = force_jobs.scores(model, rows)["mae"]
    assert errors[force_jobs.LAWS] < 0.2 * errors[force_jobs.KNOWN_PHYSICS]


def test_scores_are_what_they_say(rubbing):
    posterior, test = rubbing
    found = force_jobs.scores(posterior, test)
    states = test.q, test.v, test.u
    prediction, components = posterior.predict(*states), posterior.components(*states)
    mean = prediction.mean.numpy()
    assert found["mae"] == pytest.approx(np.abs(mean - test.a).mean(), rel=1e-9)
    assert found["mae_noise_free"] == pytest.approx(np.abs(mean - test.truth["a"]).mean(), rel=1e-9)
    assert found["mae_of_truth"] == pytest.approx(np.abs(test.truth["a"] - test.a).mean(), rel=1e-12)
    force, std = prediction.multiplier.mean.numpy(), prediction.multiplier.std.numpy()
    error = force - test.truth["lambda"]
    relative = np.sqrt(np.mean(error**2) / np.mean(test.truth["lambda"] ** 2))
    assert found["normal_force_error"] == pytest.approx(relative, rel=1e-9)
    assert found["normal_force_coverage"] == pytest.approx((np.abs(error) <= 1.96 * std).mean(), abs=0.02)
    assert 0.0 <= found["component_sum_error"] < 1e-9
    for name, truth in (("joint-friction", "Q_U.joint-friction"), ("load-friction", "Q_U.tool-friction")):
        own = components[name].joint_force.mean.numpy()
        assert found[f"force_mae.{name}"] == pytest.approx(np.abs(own - test.truth[truth]).mean(), rel=1e-9)
    assert found["force_mae.joint-friction"] != found["force_mae.load-friction"]


def test_a_force_of_everything_is_not_compared_with_a_part(rubbing):
    """`JointForces` holds friction of tool and joints together, and the truth has them one by one."""
    _, test = rubbing
    posterior = fit(test.model.with_forces(JointForces()), test, restarts=1, options=OptimizerOptions(iterations=0))
    assert not [name for name in force_jobs.scores(posterior, test) if name.startswith("force_mae")]


def test_forces_are_scored_under_the_contacts_of_the_test(rubbing):
    posterior, test = rubbing
    accelerations = {"a": test.truth["a"]}
    free = replace(test, model=test.model.with_contacts([]), truth=accelerations)
    found = force_jobs.scores(posterior, free)
    carried = posterior.with_contacts([]).predict(test.q, test.v, test.u).mean.numpy()
    assert found["mae"] == pytest.approx(np.abs(carried - test.a).mean(), rel=1e-9)
    assert found["mae"] > 2.0 * force_jobs.scores(posterior, test)["mae"]
    assert "normal_force_error" not in found


def test_black_boxes_are_scored_on_accelerations_alone(rubbing):
    _, test = rubbing
    black_box = fit(test.model.black_box(), test, options=OptimizerOptions(iterations=0))
    found = force_jobs.scores(black_box, test)
    assert set(found) == {"mae", "mae_of_truth", "mae_noise_free", "nlpd", "coverage_95", "known_physics_mae"} | {
        "coverage_95_noise_free"
    }
    assert force_jobs.curve_scores(black_box) == {}


def test_curves_are_held_against_their_laws(rubbing):
    from benchmarks.force_priors.jobs import true_curves

    posterior, _ = rubbing
    found, laws = force_jobs.curve_scores(posterior), true_curves(posterior)
    assert set(found) == set(laws) == set(posterior.latent_names)
    for latent, law in laws.items():
        curve = posterior.curve(latent)
        mean, truth = curve.mean.numpy(), law(curve.features[:, 0].numpy())
        inside = np.abs(mean - truth) <= 1.959963984540054 * curve.std.numpy()
        assert found[latent]["coverage"] == pytest.approx(inside.mean(), abs=1.1 / len(mean))
        size = np.sqrt(np.mean(truth**2))
        assert found[latent]["relative_error"] == pytest.approx(np.sqrt(np.mean((mean - truth) ** 2)) / size, rel=1e-9)


def test_the_first_points_are_trained_on_and_every_test_is_scored(results, motion, tmp_path):
    train = farthest_rows(motion, 30)
    stored(results, train=train, test=motion.rows(slice(3, None, 9)), other=motion.rows(slice(5, None, 9)))
    tests = {"there": TEST, "elsewhere": "force-data/other"}
    found = force_jobs.fit(results, fit_spec(tests=tests), tmp_path)
    posterior = load_posterior(tmp_path / force_jobs.MODEL)
    assert np.array_equal(posterior.training.q.numpy(), train.q[:12])
    assert list(found["tests"]) == ["there", "elsewhere"]
    for label, name in tests.items():
        test = force_jobs.load(results, name)
        mean = posterior.predict(test.q, test.v, test.u).mean.numpy()
        assert found["tests"][label]["mae"] == pytest.approx(np.abs(mean - test.a).mean(), rel=1e-6)
    with pytest.raises(InvalidInput, match="31 training points are asked for, but there are 30"):
        force_jobs.fit(results, fit_spec(points=31), tmp_path)


def test_regions_do_not_overlap(results, motion, tmp_path):
    """The motion, every second row turned about the base's vertical axis, so that the tool is on both sides."""
    q = motion.q.copy()
    q[:, 0] += np.where(np.arange(len(q)) % 2 == 0, 1.2, -0.8)
    turned = replace(motion, q=q, truth={}).rows(slice(0, None, 7))
    stored(results, train=turned, test=turned)
    tool = Tool(motion.model)
    x = np.array([tool.position(row)[0] for row in turned.q])
    assert min((x < 0.0).sum(), (x > 0.1).sum()) > 12
    found = force_jobs.fit(results, fit_spec(region=True), tmp_path)
    posterior = load_posterior(tmp_path / force_jobs.MODEL)
    assert np.array_equal(posterior.training.q.numpy(), turned.q[x < 0.0][:12])
    beyond = turned.rows(x > 0.1)
    mean = posterior.predict(beyond.q, beyond.v, beyond.u).mean.numpy()
    assert found["tests"]["there"]["mae"] == pytest.approx(np.abs(mean - beyond.a).mean(), rel=1e-6)


def test_data_jobs_hold_the_rows_they_promise(results, motion, tmp_path):
    spec = {"scenario": {}, "seed": 1, "seconds": 2, "rows": None, "every": 12}
    assert force_jobs.simulate(results, spec, tmp_path) == {"rows_available": 480, "rows": 40}
    kept = Dataset.load(tmp_path / force_jobs.FILE)
    assert np.array_equal(kept.q, motion.q[::12])
    force_jobs.simulate(results, spec | {"rows": 9}, tmp_path)
    assert np.array_equal(Dataset.load(tmp_path / force_jobs.FILE).q, farthest_rows(motion, 9).q)
