"""Which models a folder can hold, and how each is written as plain values; the parameters are tensors beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from forcegp.errors import FileFormatError
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.independent_gp import IndependentGP
from forcegp.models.baselines.network_ensemble import NetworkEnsemble
from forcegp.models.baselines.neural_network import NeuralNetwork
from forcegp.models.noise import Noise
from forcegp.models.protocol import Model
from forcegp.models.structured.gp import StructuredGP
from forcegp.priors import prior_from_dict, prior_to_dict


@dataclass(frozen=True)
class StoredKind:
    """One kind of model: its fields as plain JSON values, and back."""

    model: type[Model]
    to_dict: Callable[[Any], dict[str, Any]]
    from_dict: Callable[[MechanicalSystem, Mapping[str, Any]], Model]


def kind_of(model: Model) -> str:
    """The name in `KINDS` of a model. Raises FileFormatError for a model that is not registered there."""
    for name, kind in KINDS.items():
        if type(model) is kind.model:
            return name
    raise FileFormatError(f"a {type(model).__name__} cannot be stored: it has no entry in KINDS ({', '.join(KINDS)})")


def _structured_to_dict(model: StructuredGP) -> dict[str, Any]:
    return {"mean": model.mean, "prior": prior_to_dict(model.prior), "noise": _noise_to_dict(model.noise)}


def _structured_from_dict(system: MechanicalSystem, stored: Mapping[str, Any]) -> StructuredGP:
    noise = _noise_from_dict(stored["noise"])
    return StructuredGP(system, prior_from_dict(stored["prior"]), stored["mean"], noise)


def _plain_kind(model: type[Model], *fields: str) -> StoredKind:
    """A kind whose constructor takes the system, `noise` and fields that JSON can hold."""

    def to_dict(given: Any) -> dict[str, Any]:
        values = {name: getattr(given, name) for name in fields}
        return {"noise": _noise_to_dict(given.noise), **values}

    def from_dict(system: MechanicalSystem, stored: Mapping[str, Any]) -> Model:
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()}
        make = cast("Callable[..., Model]", model)
        return make(system, **{**values, "noise": _noise_from_dict(stored["noise"])})

    return StoredKind(model, to_dict, from_dict)


def _noise_to_dict(noise: Noise | None) -> dict[str, Any] | None:
    return None if noise is None else noise.to_dict()


def _noise_from_dict(stored: Mapping[str, Any] | None) -> Noise | None:
    return None if stored is None else Noise.from_dict(stored)


KINDS: dict[str, StoredKind] = {
    "forcegp structured posterior": StoredKind(StructuredGP, _structured_to_dict, _structured_from_dict),
    "forcegp independent posterior": _plain_kind(IndependentGP, "inputs"),
    "forcegp neural network": _plain_kind(NeuralNetwork, "width", "steps", "batch", "rate"),
    "forcegp network ensemble": _plain_kind(
        NetworkEnsemble, *("members", "width", "depth", "steps", "batch", "rate", "weight_decay", "beta", "held_out")
    ),
}
"""Name in `model.json` -> how a model of that kind is stored."""
