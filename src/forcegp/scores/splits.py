"""What is held out: whole episodes, or blocks of time with a guard around them; no row is ever on both sides.

Rows of one motion that follow each other are nearly equal, and a zero-phase filter mixes neighbours, so a split of
single rows tests memory. Here a `Split` names stretches of time; the training side loses in addition all rows nearer
than `guard` seconds to such a stretch (block cross-validation with a margin; Racine 2000, "Consistent cross-validatory
model-selection for dependent data: hv-block cross-validation").
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from forcegp.data import Dataset, require_disjoint
from forcegp.errors import InvalidInput, require_type, usable_arguments

FORMS = "episodes:N,N..., leave-one-out, fraction:F[:SEED] or blocks:N:K,K..."
DEFAULT_FRACTION, DEFAULT_BLOCKS = 0.25, "blocks:5:3,5"


@dataclass(frozen=True)
class Split:
    """Which stretches of time are held out, and how far training rows must stay away from them.

    Because it is given in times, it divides a recording and its decimated version at the same moments.

    Fields
    ------
    name: short, unlike those of other splits of the same data; a file name may hold it.
    words: what was done, as part of a sentence.
    held_out: the stretches to predict: episode, begin <= t, and t < end [s], infinite at the ends of a recording.
    guard: seconds between any training row and a held-out stretch of the same episode.
    """

    name: str
    words: str
    held_out: tuple[tuple[int, float, float], ...]
    guard: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.guard) and self.guard >= 0.0):
            raise InvalidInput(f"guard is {self.guard} s; it must be finite and at least 0.")

    def test_rows(self, dataset: Dataset) -> Bool[np.ndarray, " rows"]:
        """Which rows are held out."""
        return self._near(dataset, 0.0)

    def training_rows(self, dataset: Dataset) -> Bool[np.ndarray, " rows"]:
        """Which rows may be learned from: not held out, and not within the guard."""
        return ~self._near(dataset, self.guard)

    def _near(self, dataset: Dataset, margin: float) -> Bool[np.ndarray, " rows"]:
        t, inside = dataset.time, np.zeros(len(dataset), dtype=bool)
        for episode, begin, end in self.held_out:
            inside |= (dataset.episode == episode) & (t >= begin - margin) & (t < end + margin)
        return inside

    def apply(self, dataset: Dataset) -> tuple[Dataset, Dataset]:
        """`(training, test)`.

        Raises InvalidInput where a side is empty, and DatasetError where test rows repeat training rows.
        """
        train, test = self.training_rows(dataset), self.test_rows(dataset)
        for side, rows in (("hold out", test), ("learn from", train)):
            if not rows.any():
                raise InvalidInput(
                    f"split {self.name!r} leaves no row to {side}; the dataset has episodes {list(dataset.episodes)} "
                    f"and the guard is {self.guard} s."
                )
        sides = dataset.rows(train), dataset.rows(test)
        whole = all(math.isinf(begin) and math.isinf(end) for _, begin, end in self.held_out)
        # Blocks of one episode have equal metadata by nature; of those only repeated rows are refused.
        require_disjoint(sides[0] if whole else replace(sides[0], metadata={}), sides[1])
        return sides

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; None where a stretch goes to the end of the recording."""
        held_out = [
            {"episode": episode, "begin": None if math.isinf(begin) else begin, "end": None if math.isinf(end) else end}
            for episode, begin, end in self.held_out
        ]
        return {"name": self.name, "words": self.words, "held_out": held_out, "guard": self.guard}


@usable_arguments("split_named")
def split_named(dataset: Dataset, text: str, guard: float = 0.25) -> tuple[Split, ...]:
    """The splits of a text, as `forcegp score --split` takes it: several for leave-one-out, else one.

    auto: a quarter of the episodes, or with one episode blocks 3 and 5 of five.
    episodes:N,N...: whole episodes.
    leave-one-out: every episode once.
    fraction:F[:SEED]: a fraction of the episodes drawn by the seed, at least one on either side.
    blocks:N:K,K...: every episode is cut into N blocks of equal duration; those of these numbers, from 1, are held out,
        and training rows within `guard` seconds of them are left out.
    Raises InvalidInput for anything else, and where nothing would be held out or nothing left to learn from.
    """
    require_type("dataset", dataset, Dataset)
    if text == "auto":
        text = DEFAULT_BLOCKS if len(dataset.episodes) == 1 else f"fraction:{DEFAULT_FRACTION}"
    kind, *parts = text.split(":")
    if kind in ("leave-one-out", "fraction") and len(dataset.episodes) < 2:
        raise InvalidInput(f"the dataset has one episode; hold out blocks of time instead ({DEFAULT_BLOCKS}).")
    try:
        match kind, parts:
            case "leave-one-out", []:
                return tuple(_episodes_apart(dataset, [number]) for number in dataset.episodes)
            case "episodes", [words]:
                return (_episodes_apart(dataset, [int(word) for word in words.split(",")]),)
            case "fraction", [share, *seed] if len(seed) < 2:
                return (_fraction_apart(dataset, float(share), int((seed or ["0"])[0])),)
            case "blocks", [count, numbers]:
                return (_blocks_apart(dataset, int(count), [int(each) for each in numbers.split(",")], guard),)
            case _:
                pass
    except InvalidInput:
        raise
    except ValueError:
        pass  # a text where a number belongs
    raise InvalidInput(f"the split is {text!r}; give auto, {FORMS}, for example {DEFAULT_BLOCKS}.")


def _require_some(what: str, chosen: Sequence[int], known: Sequence[int]) -> None:
    if not set(chosen) < set(known) or len(set(chosen)) < len(chosen) or not chosen:
        raise InvalidInput(
            f"held-out {what} are {list(chosen)}; name some of {list(known)}, each once, and leave one to learn from, "
            f"or hold out blocks of time ({DEFAULT_BLOCKS})."
        )


def _episodes_apart(dataset: Dataset, episodes: Sequence[int]) -> Split:
    """Whole episodes."""
    _require_some("episodes", episodes, dataset.episodes)
    rest = [number for number in dataset.episodes if number not in episodes]
    words = f"trained on whole episodes ({_listed(rest)}), tested on others ({_listed(episodes)})"
    held_out = tuple((number, -math.inf, math.inf) for number in episodes)
    return Split(f"episodes-{'-'.join(map(str, episodes))}", words, held_out)


def _fraction_apart(dataset: Dataset, fraction: float, seed: int) -> Split:
    if not 0.0 < fraction < 1.0 or seed < 0:
        raise InvalidInput(f"the fraction is {fraction} and its seed {seed}; give one between 0 and 1, and 0 or more.")
    total = len(dataset.episodes)
    count = min(max(round(fraction * total), 1), total - 1)
    drawn = np.random.default_rng(seed).choice(dataset.episodes, size=count, replace=False)
    return _episodes_apart(dataset, sorted(int(number) for number in drawn))


def _blocks_apart(dataset: Dataset, blocks: int, held_out: Sequence[int], guard: float) -> Split:
    numbers, stretches = sorted(held_out), []
    _require_some("blocks", numbers, range(1, blocks + 1))
    for episode in dataset.episodes:
        time = dataset.time[dataset.episode == episode]
        edges = np.linspace(time.min(), time.max(), blocks + 1)
        if not edges[0] < edges[-1]:
            raise InvalidInput(f"episode {episode} has one row; it cannot be cut into blocks of time.")
        edges[0], edges[-1] = -math.inf, math.inf  # what lies outside of the rows seen here belongs to the ends
        stretches += [(episode, float(edges[n - 1]), float(edges[n])) for n in numbers]
    each = "the recording" if len(dataset.episodes) == 1 else "every episode"
    words = (
        f"{each} cut into {blocks} consecutive blocks of equal duration, block{'s' if len(numbers) > 1 else ''} "
        f"{_listed(numbers)} held out, and training rows within {guard:g} s of them left out"
    )
    return Split(f"blocks-{blocks}-{'-'.join(map(str, numbers))}", words, tuple(stretches), guard)


def _listed(numbers: Sequence[int]) -> str:
    *first, last = map(str, numbers)
    return f"{', '.join(first)} and {last}" if first else last
