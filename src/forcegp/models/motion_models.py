"""`MotionModel`: what a posterior may learn from recorded motions, and what models answer that cannot."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeVar

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.models.motion_intervals import HORIZONS, MotionIntervals

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
