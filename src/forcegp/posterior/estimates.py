"""`Estimates`: the numbers of a model that a fit found, how sure they are, and whether the log or the prior decides.

Covariances are a block jackknife over stretches of the log (Kuensch 1989), by one step of the search, so that errors
that last count, and what the prior leaves open of what the log does not show:

    (K - 1) / K sum_k d_k d_k^T + F^-1 G F^-1,    F = J^T J + G

with the prior's information G and the changes d_k about their mean. Intervals are those of Student's distribution.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student
from typing_extensions import override

from forcegp.errors import UnknownName, require_known
from forcegp.evidence.identifiability import BaseParameters
from forcegp.summary import Summary, listed

STRETCHES = 20
"""Of time; residuals of different ones count as independent."""
REACH = float(student.ppf(0.975, STRETCHES - 1))
"""Standard deviations from the estimate to the ends of its 95 % interval."""
HELD = 0.5
"""A number whose standard deviation is above this fraction of its prior's is one that the log does not decide."""
SEEN = 1.0
"""Information of the log about a coordinate, in that of its prior, below which the rows do not show it at all."""
NAMED = 0.3
"""Correlation from which on another number is named as one that does the same."""

Decider = Literal["log", "prior"]


@dataclass(frozen=True)
class Estimate:
    """One number: value and std in `unit`, its start and prior std, and what decides it, with the reason."""

    name: str
    unit: str
    value: float
    std: float
    start: float
    prior_std: float
    decided_by: Decider
    why: str

    @property
    def interval(self) -> tuple[float, float]:
        """Of 95 %, including what the log leaves open."""
        return self.value - REACH * self.std, self.value + REACH * self.std

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**vars(self), "interval_95": list(self.interval)}

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        doubt = "" if self.decided_by == "log" else f" (the prior decides: {self.why})"
        return f"{self.value:.4g} ± {REACH * self.std:.2g}{unit}{doubt}"


@dataclass(frozen=True, eq=False, repr=False)
class Estimates(Summary, Mapping[str, Estimate]):
    """The numbers that a fit estimated, by name: `estimates["payload.mass"].value`; `settled` if the search converged.

    `covariance` (n, n) is that of all values, in SI units; `open_directions` are combinations that the prior decides.
    """

    entries: tuple[Estimate, ...] = ()
    covariance: Float[np.ndarray, "n n"] | None = None
    open_directions: tuple[str, ...] = ()
    by_body: Mapping[str, int] | None = None
    """Of ten directions of each body, how many the prior decides, where it decides any."""
    base: BaseParameters | None = None
    """Base parameters of the recorded motion, where all bodies were estimated."""
    evidence: str = ""
    rows: int = 0
    evaluations: int = 0
    settled: bool = True
    thickened: tuple[str, ...] = ()
    """Links that were lines, plates or points, and got some thickness."""

    @override
    def __getitem__(self, name: str) -> Estimate:
        require_known("parameter", name, "this fit", list(self), UnknownName)
        return self._by_name[name]

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    @override
    def __len__(self) -> int:
        return len(self.entries)

    @cached_property
    def _by_name(self) -> dict[str, Estimate]:
        return {each.name: each for each in self.entries}

    @override
    def facts(self) -> dict[str, object]:
        """The first estimates, and what the log leaves open."""
        values = [f"{each.name} {each}" for each in self.entries]
        return {
            "estimated": listed(values, most=6),
            "from": f"{self.rows} rows, {self.evidence}",
            "decided by the prior": listed(each.name for each in self.entries if each.decided_by == "prior"),
            "converged": self.settled,
        }

    def std_of(self, names: Sequence[str], weights: Sequence[float] | None = None) -> float:
        """Standard deviation of a weighted sum of numbers, for example the mass of all bodies."""
        assert self.covariance is not None, "there are estimates"
        places = [list(self).index(name) for name in names]
        w = np.ones(len(places)) if weights is None else np.array(weights)
        return float(np.sqrt(max(w @ self.covariance[np.ix_(places, places)] @ w, 0.0)))

    @property
    def total_mass(self) -> tuple[float, float]:
        """Of all bodies that were estimated, and its standard deviation in kg."""
        names = [each.name for each in self.entries if each.name.endswith(".mass")]
        return sum(self[name].value for name in names), self.std_of(names)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values."""
        return {
            "parameters": {each.name: each.to_dict() for each in self.entries},
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "open_directions": list(self.open_directions),
            "by_body": None if self.by_body is None else dict(self.by_body),
            "base_parameters": None if self.base is None else list(self.base.expressions),
            "condition_number": None if self.base is None else self.base.condition,
            **{name: getattr(self, name) for name in ("evidence", "rows", "evaluations", "settled")},
            "thickened": list(self.thickened),
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Estimates":
        """What `to_dict` gave, without base parameters."""
        known = Estimate.__dataclass_fields__
        entries = tuple(Estimate(**{k: v for k, v in x.items() if k in known}) for x in stored["parameters"].values())
        covariance = None if stored["covariance"] is None else np.array(stored["covariance"], dtype=np.float64)
        kept: dict[str, Any] = {
            name: stored[name] for name in ("by_body", "evidence", "rows", "evaluations", "settled")
        }
        kept |= {name: tuple(stored[name]) for name in ("open_directions", "thickened")}
        return cls(entries, covariance, **kept)

    @classmethod
    def of_search(
        cls,
        parameters: Sequence[Any],
        values: Float[np.ndarray, " n"],
        slopes: Float[np.ndarray, "n k"],
        white: Float[np.ndarray, "N k+1"],
        stretches: Sequence[np.ndarray],
        prior: Float[np.ndarray, "k k"],
        **more: Any,
    ) -> "Estimates":
        """From the Jacobian of whitened residuals, with them as last column, rows by stretches, and of the prior.

        `slopes` are derivatives of the values in the coordinates. Without stretches the covariance is F^-1.
        """
        J, r, G = white[:, :-1], white[:, -1], prior.T @ prior
        information = J.T @ J
        whole, root = information + G, np.linalg.inv(np.linalg.cholesky(G)).T
        moved = []
        for at in stretches:
            own = J[at]
            # in coordinates in which the prior is the identity, what is left has eigenvalues of 1 at least
            sizes, vectors = np.linalg.eigh(root.T @ (whole - own.T @ own) @ root)
            turned = root @ vectors
            moved.append(turned @ ((turned.T @ (own.T @ r[at])) / np.maximum(sizes, 1.0)))
        covariance = None
        if moved:
            apart, count = np.stack(moved) - np.mean(moved, axis=0), len(moved)
            unseen = np.linalg.solve(whole, np.linalg.solve(whole, G).T)
            covariance = (count - 1) / count * apart.T @ apart + unseen
        given = parameters, values, slopes, np.linalg.inv(whole), prior
        return cls.of_covariance(*given, covariance=covariance, **more)

    @classmethod
    def of_covariance(
        cls,
        parameters: Sequence[Any],
        values: Float[np.ndarray, " n"],
        slopes: Float[np.ndarray, "n k"],
        inverse: Float[np.ndarray, "k k"],
        prior: Float[np.ndarray, "k k"],
        covariance: Float[np.ndarray, "k k"] | None = None,
        **more: Any,
    ) -> "Estimates":
        """From F^-1, the inverse of all information; `covariance` is that of the coordinates, if another."""
        G = prior.T @ prior
        information = np.linalg.inv(inverse) - G
        spread = slopes @ (inverse if covariance is None else covariance) @ slopes.T
        std = np.sqrt(np.maximum(spread.diagonal(), 0.0))
        a_priori = slopes @ np.linalg.solve(G, slopes.T)
        prior_std = np.sqrt(np.maximum(a_priori.diagonal(), 0.0))
        posterior = slopes @ inverse @ slopes.T
        size = np.sqrt(np.maximum(posterior.diagonal(), 1e-300))
        alike = abs(posterior / np.outer(size, size))
        np.fill_diagonal(alike, 0.0)
        shown = (slopes @ np.linalg.solve(G, information @ np.linalg.solve(G, slopes.T))).diagonal()
        names, entries = [each.name for each in parameters], []
        for k, each in enumerate(parameters):
            held = size[k] > HELD * prior_std[k]
            other = int(alike[k].argmax()) if len(alike) > 1 else k
            if not held:
                why = "its rows show it"
            elif shown[k] < SEEN * prior_std[k] ** 2:
                why = "no row shows it"
            elif alike[k, other] >= NAMED:
                why = f"rows show it only together with {names[other]}"
            else:
                why = "rows show it only together with others"
            numbers = float(values[k]), float(std[k]), each.start, float(prior_std[k])
            entries.append(Estimate(each.name, each.unit, *numbers, "prior" if held else "log", why))
        return cls(tuple(entries), spread, _open_directions(information, prior, slopes, names), **more)


def _open_directions(
    information: np.ndarray, prior: np.ndarray, slopes: np.ndarray, names: Sequence[str]
) -> tuple[str, ...]:
    """Combinations of numbers, in their prior deviations, of which the log holds less than the prior; worst first."""
    root = np.linalg.inv(np.linalg.cholesky(prior.T @ prior)).T  # a body of which some parts are open has more rows
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    out = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= 1.0:
            break
        change = slopes @ (root @ vector)
        scale = np.sqrt(np.maximum(((slopes @ root) ** 2).sum(1), 1e-300))
        share = change / scale
        main = [k for k in np.argsort(-abs(share)) if abs(share[k]) >= 0.5 * abs(share).max()][:3]
        sign = 1.0 if share[main[0]] > 0 else -1.0
        text = " ".join(f"{'-' if sign * change[k] < 0 else '+'} {abs(change[k]):.2g} {names[k]}" for k in main)
        out.append(text.removeprefix("+ "))
    return tuple(out)
