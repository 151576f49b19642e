"""Gymnasium environments whose robot moves as a model predicts; importing this module registers forcegp/Robot-v0."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from typing_extensions import override

from forcegp.control.tracking import per_joint, usual_integrator
from forcegp.errors import InvalidInput, require_number, require_type
from forcegp.posterior import Posterior, Predictor, load_posterior
from forcegp.robots.arguments import whole_number

LONGEST = 1.0  # s, of a step


class RobotVectorEnv(VectorEnv):
    """`num_envs` robots at once under the learned forces, by `predictor.rollouts`; the task is the caller's.

    Observations are [q, v] (num_envs, 2 nv), actions torques u (num_envs, nv) in Nm (N), held for `dt` seconds. An
    episode that ended, or whose motion diverges (`terminated`, `info["diverged"]`), begins anew with the next step. It
    ends as well where a joint leaves the limits of position or velocity that the robot's file states.

    * model: a predictor, a posterior, or the folder of one.
    * reward(q, v, u, q_next, v_next) -> (n,), terminated(q, v) -> (n,), start(generator, n) -> q, v take and return
      arrays of n rows; without them 0, never, and at rest at q = 0. `steps` truncates an episode. torque_limits have to
      be finite. integrator: None takes `usual_integrator`; the attribute says which it is.

    Raises InvalidInput for settings that do not fit, and for what the caller's functions return.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        model: Any,
        dt: float = 0.02,
        steps: int | None = None,
        torque_limits: Any = None,
        reward: Callable[..., np.ndarray] | None = None,
        terminated: Callable[..., np.ndarray] | None = None,
        start: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None,
        integrator: str | None = None,
    ) -> None:
        model = load_posterior(model) if isinstance(model, str | Path) else model
        if not isinstance(model, Predictor):
            model = require_type("model", model, Posterior).predictor(covariance="none")
        self.predictor = model
        self.num_envs = whole_number("num_envs", num_envs, 1)
        self.steps = None if steps is None else whole_number("steps", steps, 1)
        words = f"one step lasts {LONGEST:g} s at most; a time step is above 0"
        require_number("dt", dt, words, below=LONGEST * (1.0 + 1e-9))
        self.dt, self.reward, self.terminated, self.start = dt, reward, terminated, start
        robot = self.predictor.posterior.model.robot
        robot.require_vectors("environments")
        self.integrator = integrator or usual_integrator(model, dt)
        limits = [joint.effort_limit for joint in robot.joints] if torque_limits is None else torque_limits
        self._limits = limits = per_joint("torque_limits", limits, robot.nv).numpy()
        if not limits.any() or not np.isfinite(limits).all():
            raise InvalidInput(f"torque_limits are {limits.tolist()}; give finite ones in Nm or N, not all zero.")
        # a velocity of 0 is what files say that state none
        ends = [(joint.lower, joint.upper, joint.velocity_limit or np.inf) for joint in robot.joints]
        low, high, fastest = np.array(ends, dtype=float).T
        self._low, self._high = np.append(low, -fastest), np.append(high, fastest)
        self.single_observation_space = Box(self._low, self._high, dtype=np.float64)
        self.single_action_space = Box(-limits, limits, dtype=np.float64)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.q = self.v = np.zeros((num_envs, robot.nv))
        self.age = np.zeros(num_envs, int)
        self._ended = np.ones(num_envs, bool)

    @override
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """First observations (num_envs, 2 nv); a seed decides what `start` draws."""
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, bool))
        return self._observed(), {}

    @override
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of `dt`; robots whose episode had ended begin a new one instead, with reward 0."""
        u = np.clip(np.asarray(actions, float).reshape(self.q.shape), -self._limits, self._limits)
        anew, q, v = self._ended, self.q, self.v
        motion = self.predictor.rollouts(q, v, u[:, None], self.dt, integrator=self.integrator, threads=1)
        q_next, v_next = motion.q[:, 1].numpy(), motion.v[:, 1].numpy()
        lasted = anew | np.isfinite(q_next + v_next).all(axis=1)
        moves = (lasted & ~anew)[:, None]
        self.q, self.v = np.where(moves, q_next, q), np.where(moves, v_next, v)
        rewards, over = np.zeros(self.num_envs), ~lasted | self._beyond(self.q, self.v)
        if self.reward is not None:
            rewards = self._one_each("reward", self.reward(q, v, u, self.q, self.v), "fiub", "finite numbers")
        if self.terminated is not None:
            over = over | self._one_each("terminated", self.terminated(self.q, self.v), "b", "True or False")
        self.age = self.age + 1
        late = np.zeros(self.num_envs, bool) if self.steps is None else self.age >= self.steps
        if anew.any():
            rewards, over, late = np.where(anew, 0.0, rewards), over & ~anew, late & ~anew
            self._begin(anew)
        self._ended = over | late
        return self._observed(), rewards, over, late, {"diverged": ~lasted}

    def _begin(self, which: np.ndarray) -> None:
        count, nv = int(which.sum()), self.q.shape[1]
        q = v = np.zeros((count, nv))
        if self.start is not None:
            q, v = (np.asarray(x) for x in self.start(self.np_random, count))
            fits = q.shape == v.shape == (count, nv) and {q.dtype.kind, v.dtype.kind} <= {"f", "i"}
            if not fits or not np.isfinite(q + v).all() or self._beyond(q, v).any():
                seen = f"start returned q of shape {q.shape} and v of shape {v.shape}"
                raise InvalidInput(f"{seen}; return finite ones ({count}, {nv}) within the limits of the joints.")
        self.q, self.v, self.age = self.q.copy(), self.v.copy(), np.where(which, 0, self.age)
        self.q[which], self.v[which], self._ended = q, v, np.zeros(self.num_envs, bool)

    def _observed(self) -> np.ndarray:
        return np.concatenate([self.q, self.v], axis=1).clip(self._low, self._high)

    def _beyond(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        x = np.concatenate([q, v], axis=1)
        return np.any((x < self._low) | (x > self._high), axis=1)

    def _one_each(self, name: str, given: Any, kinds: str, what: str) -> np.ndarray:
        values = np.asarray(given)
        if values.shape != (self.num_envs,) or values.dtype.kind not in kinds or not np.isfinite(values).all():
            raise InvalidInput(f"{name} returned {given!r:.80}; return {what} ({self.num_envs},), one per robot.")
        return values


class RobotEnv(gymnasium.Env):
    """One robot of `RobotVectorEnv`, with its settings and arrays of one row: make("forcegp/Robot-v0", model=...)."""

    def __init__(self, **settings: Any) -> None:
        self.robots = RobotVectorEnv(1, **settings)
        self.metadata = {"render_modes": []}
        self.observation_space = self.robots.single_observation_space
        self.action_space = self.robots.single_action_space

    @override
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """The first observation (2 nv,)."""
        super().reset(seed=seed)
        return self.robots.reset(seed=seed)[0][0], {}

    @override
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation (2 nv,), reward, terminated, truncated and info after `dt` seconds."""
        seen, rewards, over, late, info = self.robots.step(np.asarray(action)[None])
        return seen[0], float(rewards[0]), bool(over[0]), bool(late[0]), {"diverged": bool(info["diverged"][0])}


gymnasium.register("forcegp/Robot-v0", f"{__name__}:RobotEnv", vector_entry_point=f"{__name__}:RobotVectorEnv")
