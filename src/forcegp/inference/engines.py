"""Engines: how the posterior of the latents is computed from many rows, what memory that needs, and which one to take.

`Exact` takes (rN)^3 time and (rN)^2 memory, `Inducing` N P^2 and P^2, with N rows of rank r and P points.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, NamedTuple

import torch
from typing_extensions import override

from forcegp.errors import InvalidInput, require_known, require_number, usable_arguments
from forcegp.inference.dense_kernels import LatentKernels
from forcegp.inference.inducing import InducingPosterior
from forcegp.inference.likelihood import Terms
from forcegp.inference.memory import USABLE, free_memory, gib, require_memory
from forcegp.inference.posterior import ExactPosterior, LatentPosterior

MOST_EXACT_ROWS = 1500
"""Rows up to which the exact engine is taken without a question, and all hyper-parameters are found on all of them."""

MOST_EXACT_ENTRIES = 16_000
"""Size rN of the covariance beyond which factorising it takes minutes, and many inducing points are taken."""

FEW_FEATURES = 3  # features of a latent up to which inducing points can be expected to leave nothing out

MANY_POINTS = 1000  # inducing points of a latent with more features: measured, docs/how-to/large-data.md

ENOUGH = 0.02
"""Prior variance of a row in units of its noise that inducing points may leave out: docs/how-to/large-data.md."""


@dataclass(frozen=True)
class ProblemSize:
    """`rows` with `outputs` each, `latents` functions of at most `features` features, mixing vectors of rank `rank`."""

    rows: int
    outputs: int
    rank: int
    latents: int
    features: int

    @classmethod
    def of(cls, terms: Terms) -> "ProblemSize":
        """From the data; the rank is that of some of the rows."""
        rows, outputs, latents = terms.W.shape
        some = terms.W[:: max(1, rows // 100)]
        rank = int(torch.linalg.matrix_rank(some, rtol=1e-12).max()) if some.numel() else 0
        return cls(rows, outputs, rank, latents, max((z.shape[-1] for z in terms.features), default=0))


class Engine(ABC):
    """One way to compute a posterior; a frozen value whose fields are its settings."""

    name: ClassVar[str]
    remedy: ClassVar[str]
    """What to do where it needs more memory than is free."""

    @abstractmethod
    def required_bytes(self, size: ProblemSize) -> int:
        """Memory that conditioning on so many rows takes at least."""

    @abstractmethod
    def condition(self, kernels: LatentKernels, terms: Terms, near: LatentPosterior | None = None) -> LatentPosterior:
        """The posterior given the data, sooner with another at hand. Raises NotEnoughMemory, NumericalError."""

    def require_memory(self, size: ProblemSize, device: torch.device) -> None:
        """Raise NotEnoughMemory where conditioning needs more memory than is free."""
        require_memory(self.required_bytes(size), f"engine {self.name!r} on N={size.rows} rows", self.remedy, device)

    def to_dict(self) -> dict[str, Any]:
        """Name and settings as plain JSON values."""
        return {"name": self.name, **asdict(self)}  # type: ignore[call-overload]  # every engine is a dataclass


@dataclass(frozen=True)
class Exact(Engine):
    """The factorised covariance of all rows (the default up to 1500 rows): the only engine that can leave rows out."""

    name: ClassVar[str] = "exact"
    remedy: ClassVar[str] = "use engine='inducing', or fewer points"

    @override
    def required_bytes(self, size: ProblemSize) -> int:
        return 8 * ((size.rows * size.rank) ** 2 + size.latents * size.rows**2)

    @override
    def condition(self, kernels: LatentKernels, terms: Terms, near: LatentPosterior | None = None) -> LatentPosterior:
        self.require_memory(ProblemSize.of(terms), terms.W.device)
        return ExactPosterior.condition(kernels, terms)


@dataclass(frozen=True)
class Inducing(Engine):
    """Variational inducing points: at most `points` for each latent, fewer where they leave out little.

    `tolerance`: what they may leave out of the prior variance of a row in units of its noise, on average.
    """

    name: ClassVar[str] = "inducing"
    remedy: ClassVar[str] = "give Inducing fewer points, or fewer rows"
    points: int = 500
    tolerance: float = ENOUGH

    def __post_init__(self) -> None:
        if isinstance(self.points, bool) or not isinstance(self.points, int) or self.points < 1:
            raise InvalidInput(f"Inducing points is {self.points!r}; it must be a whole number >= 1")
        require_number("Inducing tolerance", self.tolerance, "it must be at least 0", 0.0)

    @override
    def required_bytes(self, size: ProblemSize) -> int:
        weights = size.latents * self.points
        return 8 * (3 * weights**2 + 20_000 * self.points + 12 * size.rows * size.latents * size.outputs)

    @override
    def condition(self, kernels: LatentKernels, terms: Terms, near: LatentPosterior | None = None) -> LatentPosterior:
        self.require_memory(ProblemSize.of(terms), terms.W.device)
        return InducingPosterior.condition(kernels, terms, points=self.points, tolerance=self.tolerance, near=near)


ENGINES: dict[str, type[Engine]] = {kind.name: kind for kind in (Exact, Inducing)}


class Choice(NamedTuple):
    """An engine and why it was chosen, in one sentence."""

    engine: Engine
    reason: str


@usable_arguments("engine")
def engine_of(given: Engine | str) -> Engine | None:
    """The engine of that name, or itself; None for "auto". Raises InvalidInput for anything else."""
    if isinstance(given, Engine):
        return given
    if given == "auto":
        return None
    require_known("engine", given, "forcegp", ("auto", *ENGINES))
    return ENGINES[given]()


def engine_from_dict(stored: object) -> Engine:
    """The engine that `to_dict` stored. Raises InvalidInput for anything else."""
    if not isinstance(stored, Mapping):
        raise InvalidInput(f"stored engine {stored!r} is not a name with settings; there are {', '.join(ENGINES)}")
    kind = ENGINES.get(str(stored.get("name")))
    known = {field.name for field in fields(kind)} if kind is not None else set()  # type: ignore[arg-type]  # a dataclass
    settings = {name: x for name, x in stored.items() if name != "name"}
    if kind is None or not set(settings) <= known:
        raise InvalidInput(f"stored engine {dict(stored)!r} is unknown; there are {', '.join(ENGINES)}")
    return kind(**settings)


def choose_engine(size: ProblemSize, device: torch.device, *, inducing: bool = True) -> Choice:
    """By rows, features and memory; without `inducing`, no few points. Raises NotEnoughMemory where none fits."""
    exact, rows = Exact(), f"{size.rows} rows"
    needed, free = exact.required_bytes(size), free_memory(device)
    fits = needed <= USABLE * free
    if not size.latents:
        return Choice(exact, "exact: there is no unknown force to learn")
    if size.rows <= MOST_EXACT_ROWS and fits:
        return Choice(exact, f"exact: {rows} need {gib(needed)}")
    if inducing and size.features <= FEW_FEATURES:
        return Choice(Inducing(), f"inducing: {rows}, and the processes have {size.features} features at most")
    if fits and size.rows * size.rank <= MOST_EXACT_ENTRIES:
        return Choice(exact, f"exact: {rows} need {gib(needed)}, {gib(free)} are free")
    many = Inducing(points=MANY_POINTS)
    many.require_memory(size, device)
    return Choice(many, f"inducing: the exact covariance of {rows} needs {gib(needed)}, {gib(free)} are free")
