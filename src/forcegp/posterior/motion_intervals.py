"""Intervals of predicted motions that hold, from stretches of training time that were left out.

The half width of joint j at horizon h is c_hj 1.96 sqrt(s_hj^2 + r_hj^2), with the spread s of sampled functions (0
without), the rms r of errors, and c_hj that makes it hold 95 % of the left-out motions (split conformal prediction: Lei
et al. 2018, JASA 113). Between horizons, numbers are linear in time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

HORIZONS = (0.1, 0.25, 0.5, 1.0)  # s, by default
DEVIATIONS = 1.959963984540054  # of a normal distribution, which hold 95 % of it


@dataclass(frozen=True, eq=False)
class MotionIntervals:
    """Widths by horizon [s] of q (or steps from it) and v: `rms`, and `factors` with samples and without."""

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
        return cls(**arrays, inputs=tuple(stored.get("inputs", ())))
