"""Environments of gymnasium: its own checks, the motion against the predictor's, and episodes."""

import numpy as np
import pytest
from tests.control.test_mppi import predictor

from forcegp import Dataset, Noise, fit
from forcegp.errors import InvalidInput

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from forcegp.control.environments import RobotVectorEnv  # noqa: E402

__all__ = ["predictor"]  # a fixture


@pytest.fixture
def settings(predictor):
    own = {"start": lambda generator, n: (generator.uniform(-0.5, 0.5, (n, 1)), np.zeros((n, 1)))}
    own["reward"] = lambda q, v, u, q_next, v_next: -np.square(q_next).sum(axis=1)
    return {"model": predictor, "torque_limits": 5.0, "dt": 0.05, **own}


@pytest.mark.filterwarnings("ignore")  # advice on bounds and rendering
def test_gymnasiums_own_checks_find_nothing(settings):
    env = gymnasium.make("forcegp/Robot-v0", **settings, max_episode_steps=5)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=1)
    assert [env.step(env.action_space.sample())[3] for _ in range(5)] == [False] * 4 + [True]
    assert gymnasium.make_vec("forcegp/Robot-v0", num_envs=4, **settings).reset(seed=0)[0].shape == (4, 2)


def test_the_step_is_the_predictors_and_the_reward_the_callers(settings, predictor):
    env = RobotVectorEnv(3, **settings)
    seen, _ = env.reset(seed=2)
    u = np.array([[1.0], [-2.0], [99.0]])
    after, rewards, over, late, info = env.step(u)
    q, v = predictor.step(seen[:, :1], seen[:, 1:], u.clip(-5.0, 5.0), 0.05, "rk4")
    assert env.integrator == "rk4"
    np.testing.assert_allclose(after, np.hstack([q, v]), rtol=1e-9)
    np.testing.assert_allclose(rewards, -(q[:, 0].numpy() ** 2))
    for flags in (over, late, info["diverged"]):
        assert not flags.any()
    assert np.array_equal(RobotVectorEnv(3, **settings).reset(seed=2)[0], seen)


def test_an_episode_that_ended_begins_anew_without_a_reward(settings):
    env = RobotVectorEnv(7, **settings, steps=2)
    env.reset(seed=4)
    u = np.linspace(-3.0, 3.0, 7)[:, None]
    env.step(u)
    assert env.step(u)[3].all()
    again, rewards, *_ = env.step(u)
    assert not rewards.any()
    assert not again[:, 1].any()  # at rest again


def test_a_motion_that_diverges_ends_its_episode_at_its_last_state(settings):
    env = RobotVectorEnv(2, **settings)
    env.reset(seed=0)
    env.v = np.full((2, 1), 999.9)  # far beyond its limit, where the other one only ends
    with pytest.warns(UserWarning, match="diverged"):
        after, _, over, _, info = env.step(np.array([[5.0], [-5.0]]))
    assert info["diverged"].tolist() == [True, False]
    assert over.all()
    assert env.v[0] == 999.9
    assert np.isfinite(after).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"torque_limits": 0.0}, "not all zero"), ({"torque_limits": np.inf}, "give finite ones"),
        ({"num_envs": 0}, "num_envs"), ({"dt": -0.1}, "time step"),
        ({"dt": 10.0}, "dt is 10.0; one step lasts 1 s at most"), ({"steps": 0}, "steps"),
    ],
)  # fmt: skip
def test_settings_that_mean_nothing(settings, changes, message):
    with pytest.raises(InvalidInput, match=message):
        RobotVectorEnv(**settings | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": lambda *x: np.zeros((1, 1))}, r"reward returned .*; return finite numbers \(1,\), one per robot"),
        ({"reward": lambda *x: np.array([np.nan])}, "reward returned"),
        ({"terminated": lambda *x: np.array([0.0])}, "terminated returned .* return True or False"),
        ({"start": lambda generator, n: (np.full((n, 1), 50.0), np.zeros((n, 1)))}, "within the limits of the joints"),
        ({"start": lambda generator, n: (np.zeros(n), np.zeros(n))}, r"q of shape \(1,\) and v of shape \(1,\)"),
        ({"start": lambda generator, n: (np.full((n, 1), np.nan), np.zeros((n, 1)))}, "return finite ones"),
    ],
)
def test_what_the_callers_functions_return_is_checked(settings, changes, message):
    env = RobotVectorEnv(**settings | changes)
    with pytest.raises(InvalidInput, match=message):
        env.reset(seed=0), env.step(np.zeros((1, 1)))


def test_an_episode_ends_at_the_limits_of_a_joint(settings):
    env = RobotVectorEnv(2, **settings | {"start": lambda generator, n: (np.full((n, 1), 8.9), np.zeros((n, 1)))})
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert (env.single_observation_space.high == [9.0, 9.0]).all()
    for _ in range(40):
        seen, _, over, *_ = env.step(np.array([[5.0], [-5.0]]))
        assert env.observation_space.contains(seen)
        if over.any():
            break
    assert over.tolist() == [True, False]


def test_models_without_functions_and_what_is_none(settings, predictor):
    rows = predictor.posterior.training
    data = Dataset(q=rows.q, v=rows.v, u=rows.u, a=rows.a, time=np.arange(len(rows.q)), model=predictor.posterior.model)
    bare = fit(data.model.known.with_forces(noise=Noise(0.01, learn=False)), data, restarts=1)
    assert RobotVectorEnv(**settings | {"model": bare}).reset(seed=0)[0].shape == (1, 2)
    with pytest.raises(InvalidInput, match="model is a int; give a Posterior"):
        RobotVectorEnv(**settings | {"model": 3})
