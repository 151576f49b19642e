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
class Stretch:
    """The time `begin` <= t < `end` [s] of one episode; infinite where it goes to the end of the recording."""

    episode: int
    begin: float = -math.inf
    end: float = math.inf

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; None where there is no end."""
        ends = {name: getattr(self, name) for name in ("begin", "end")}
        return {"episode": self.episode} | {name: t if math.isfinite(t) else None for name, t in ends.items()}


@dataclass(frozen=True)
class Split:
    """Which stretches of time are held out, and how far training rows must stay away from them.

    Because it is given in times, it divides a recording and its decimated version at the same moments.

    Fields
    ------
    name: short, unlike those of other splits of the same data; a file name may hold it.
    words: what was done, as part of a sentence.
    held_out: the stretches to predict.
    guard: seconds between any training row and a held-out stretch of the same episode.
    """

    name: str
    words: str
    held_out: tuple[Stretch, ...]
    guard: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.guard) and self.guard >= 0.0):
            raise InvalidInput(f"guard is {self.guard} s; it must be finite and at least 0.")
        if not self.held_out:
            raise InvalidInput("nothing is held out; name at least one episode or block.")
        for one in self.held_out:
            if not one.begin < one.end:
                raise InvalidInput(f"a held-out stretch begins at {one.begin} s and ends at {one.end} s; end it later.")

    def test_rows(self, dataset: Dataset) -> Bool[np.ndarray, " rows"]:
        """Which rows are held out."""
        return self._near(dataset, 0.0)

    def training_rows(self, dataset: Dataset) -> Bool[np.ndarray, " rows"]:
        """Which rows may be learned from: not held out, and not within the guard."""
        return ~self._near(dataset, self.guard)

    def _near(self, dataset: Dataset, margin: float) -> Bool[np.ndarray, " rows"]:
        inside = np.zeros(len(dataset), dtype=bool)
        for stretch in self.held_out:
            after, before = dataset.time >= stretch.begin - margin, dataset.time < stretch.end + margin
            inside |= (dataset.episode == stretch.episode) & after & before
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
        whole = all(stretch == Stretch(stretch.episode) for stretch in self.held_out)
        # Blocks of one episode have equal metadata by nature; of those only repeated rows are refused.
        require_disjoint(sides[0] if whole else replace(sides[0], metadata={}), sides[1])
        return sides

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        held_out = [stretch.to_dict() for stretch in self.held_out]
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


def _episodes_apart(dataset: Dataset, episodes: Sequence[int]) -> Split:
    """Whole episodes."""
    if len(set(episodes)) < len(episodes) or not set(episodes) <= set(dataset.episodes):
        known = list(dataset.episodes)
        raise InvalidInput(f"held-out episodes are {list(episodes)}; name some of {known}, each once.")
    rest = [number for number in dataset.episodes if number not in episodes]
    if not rest:
        raise InvalidInput(
            f"all episodes {list(dataset.episodes)} are held out; leave one to learn from, or hold out blocks of time "
            f"({DEFAULT_BLOCKS})."
        )
    words = f"trained on whole episodes ({_listed(rest)}), tested on others ({_listed(episodes)})"
    return Split(f"episodes-{'-'.join(map(str, episodes))}", words, tuple(Stretch(number) for number in episodes))


def _fraction_apart(dataset: Dataset, fraction: float, seed: int) -> Split:
    if not 0.0 < fraction < 1.0 or seed < 0:
        raise InvalidInput(f"the fraction is {fraction} and its seed {seed}; give one between 0 and 1, and 0 or more.")
    total = len(dataset.episodes)
    count = min(max(round(fraction * total), 1), total - 1)
    drawn = np.random.default_rng(seed).choice(dataset.episodes, size=count, replace=False)
    return _episodes_apart(dataset, sorted(int(number) for number in drawn))


def _blocks_apart(dataset: Dataset, blocks: int, held_out: Sequence[int], guard: float) -> Split:
    numbers = sorted(held_out)
    if blocks < 2 or not set(numbers) < set(range(1, blocks + 1)) or len(set(numbers)) < len(numbers):
        raise InvalidInput(
            f"held-out blocks are {list(held_out)} of {blocks}; name some of 1 to {blocks}, each once, and "
            "leave one to learn from."
        )
    stretches = []
    for episode in dataset.episodes:
        time = dataset.time[dataset.episode == episode]
        edges = np.linspace(time.min(), time.max(), blocks + 1)
        if not edges[0] < edges[-1]:
            raise InvalidInput(f"episode {episode} has one row; it cannot be cut into blocks of time.")
        edges[0], edges[-1] = -math.inf, math.inf  # what lies outside of the rows seen here belongs to the ends
        stretches += [Stretch(episode, float(edges[n - 1]), float(edges[n])) for n in numbers]
    each = "the recording" if len(dataset.episodes) == 1 else "every episode"
    plural = "s" if len(numbers) > 1 else ""
    words = (
        f"{each} cut into {blocks} consecutive blocks of equal duration, block{plural} {_listed(numbers)} held out, "
        f"and training rows within {guard:g} s of them left out"
    )
    return Split(f"blocks-{blocks}-{'-'.join(map(str, numbers))}", words, tuple(stretches), guard)


def _listed(numbers: Sequence[int]) -> str:
    *first, last = map(str, numbers)
    return f"{', '.join(first)} and {last}" if first else last
