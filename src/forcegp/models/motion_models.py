"""What a posterior may learn from recorded motions: itself, and intervals of predicted motions that hold.

Widths of intervals come from stretches of training time that were left out.
A motion is wrong for more reasons than the functions that the data leave open: measured initial states, noise of u, and
whatever the model cannot be. At horizon h, with the spread s of sampled functions and the root mean square r of errors
of left-out motions, the half width of the 95 % interval of joint j is

    c_hj 1.96 sqrt(s_hj^2 + r_hj^2),

where c_hj makes the interval hold 95 % of the left-out motions (split conformal prediction with normalised scores: Lei,
G'Sell, Rinaldo, Tibshirani & Wasserman 2018, "Distribution-free predictive inference for regression", JASA 113).
Without samples the same holds with s = 0 and a factor of its own. Between horizons, numbers are linear in time.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import InvalidInput

HORIZONS = (0.1, 0.25, 0.5, 1.0)  # s, by default
DEVIATIONS = 1.959963984540054  # of a normal distribution, which hold 95 % of it


@dataclass(frozen=True, eq=False)
class MotionIntervals:
    """Widths by horizon [s], of q and v: `rms` in their units, `factors` with samples of functions and without.

    Where a base moves, those of q belong to steps in its axes. `inputs` are the columns of u of these motions: some may
    hold what an observer found.
    """

    horizons: Float[np.ndarray, " H"]
    rms: Float[np.ndarray, "H 2 nv"]
    factors: Float[np.ndarray, "2 H 2 nv"]
    inputs: tuple[str, ...] = ()

    def half_width(self, quantity: str, time: Tensor, spread: Tensor | None) -> Float[Tensor, "*batch rows nv"]:
        """Of the 95 % interval; `spread` is the standard deviation of samples (..., T+1, nv)."""
        kind = ("q", "v").index(quantity)
        rms, factor = self.rms[:, kind], self.factors[int(spread is None), :, kind]
        at = time.cpu().numpy()
        ends = np.array([0.0, *self.horizons])
        # beyond the last horizon errors go on as they grew
        beyond = np.maximum(at / self.horizons[-1], 1.0)[:, None]
        r = np.stack([np.interp(at, ends, [0.0, *each]) for each in rms.T], axis=-1) * beyond
        c = np.stack([np.interp(at, self.horizons, each) for each in factor.T], axis=-1)
        r, c = (torch.as_tensor(x, device=time.device) for x in (r, c))
        return DEVIATIONS * c * (r if spread is None else (spread.square() + r.square()).sqrt())

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        arrays = {name: getattr(self, name).tolist() for name in ("horizons", "rms", "factors")}
        return arrays | {"inputs": list(self.inputs)}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "MotionIntervals":
        """What `to_dict` gave."""
        arrays = {name: np.array(stored[name], dtype=np.float64) for name in ("horizons", "rms", "factors")}
        return cls(**arrays, inputs=tuple(stored["inputs"]))


AnyModel = TypeVar("AnyModel", bound="MotionModel")


class MotionModel(ABC):
    """Learns from motions where a class says so; else the methods raise InvalidInput."""

    @property
    @abstractmethod
    def description(self) -> str:
        """What kind of model it is, in a few words, for titles and tables."""

    def refined_on_motions(
        self: AnyModel,
        dataset: Dataset,
        seconds: float = 1.0,
        *,
        inertias: bool = True,
        report: Callable[[int, float], None] | None = None,
    ) -> AnyModel:
        """Known forces, inertias and latent functions fitted to the recorded positions, beginning from this posterior.

        Parameters
        ----------
        dataset: a recording in equal steps of time, also in several episodes. Of each row q and u count, and v where a
            window begins.
        seconds: length of the windows that motions are computed over: some tenths of a second to some seconds.
        inertias: also those of the bodies, near the ones that the system has.
        report: called as report(step, rms of q in rad or m).

        Where a base moves, errors of positions are steps in its axes. Observed wind counts as known.

        The result predicts for the refined system, `posterior.system`: friction and rotors that it lists are refined.
        Its `settings["motions"]` hold what was found, with standard errors, and what the motions did not tell.
        Raises InvalidInput for models without physics, windows that no episode has room for and uneven steps,
        NumericalError where no motion is found near the recorded one.
        """
        raise InvalidInput(
            f"a {self.description} has no forces that motions could refine; fit a StructuredGP or an analytical model."
        )

    def calibrated_on_motions(
        self: AnyModel,
        dataset: Dataset,
        horizons: Sequence[float] = HORIZONS,
        *,
        integrator: str = "rk4",
        report: Callable[[int, int], None] | None = None,
    ) -> AnyModel:
        """The same model with intervals of motions that hold: of stretches of the training time, left out in turn.

        For each of four stretches the model is made again from the other rows at the same hyper-parameters (refined on
        their motions if it was), and predicts motions in the stretch. `rollout(...).interval()` then uses the widths.
        Of a model that observes wind, those are of what `observing` gives for this model and a recording.

        Parameters
        ----------
        dataset: the recording that the model learned from, in equal steps of time.
        horizons: lengths of the motions in s, at which widths are found.
        integrator: of these motions, as for `rollout`.
        report: called as report(stretch, stretches).

        Raises InvalidInput for models without physics, and where fewer than two stretches last for the longest horizon.
        """
        raise InvalidInput(
            f"a {self.description} would have to be trained again for every stretch that is left out; take a "
            "StructuredGP or an analytical model."
        )

    @property
    def motion_intervals(self) -> MotionIntervals | None:
        """Widths of the intervals of motions, where they were calibrated; a rollout carries them."""
        return None
