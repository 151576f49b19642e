"""What is held out: whole episodes, or blocks of time with a guard around them; and the motions that begin there.

Neighbouring rows are nearly equal, and filters mix them, so a split of single rows would test memory (Racine 2000,
"Consistent cross-validatory model-selection for dependent data: hv-block cross-validation").
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool

from forcegp.data import Dataset, repeated_rows
from forcegp.data.views import EVEN_STEPS, RecordedMotions, median_step, recorded_motions, stretches_without_gap
from forcegp.doubts import listed
from forcegp.errors import DatasetError, InvalidInput, require_type, usable_arguments
from forcegp.posterior import Posterior, observing
from forcegp.posterior.drift import in_its_record
from forcegp.posterior.rollout import predicted
from forcegp.robots.arguments import whole_number
from forcegp.scores.accuracy import Table
from forcegp.summary import plain

FORMS, DEFAULT_BLOCKS = "folds, episodes:N,N..., leave-one-out or blocks:N:K,K...", "blocks:5:3,5"
FOLDS, MANY = 4, 8  # groups of episodes; and episodes, beyond which two of these groups show as much
COUNTS, SHOWN = (5, 10, 20), 0.05
"""Of blocks, two of five held out: the fewest that leave this share of every joint's squared velocity on both sides."""


@dataclass(frozen=True)
class Split:
    """Which stretches of time are held out, and how far training rows must stay away from them.

    Because it is given in times, it divides a recording and its decimated version at the same moments.

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
        """`(training, test)`. Raises InvalidInput where a side is empty, and DatasetError where both share rows."""
        train, test = self.training_rows(dataset), self.test_rows(dataset)
        for side, rows in (("hold out", test), ("learn from", train)):
            if not rows.any():
                raise InvalidInput(
                    f"split {self.name!r} leaves no row to {side}; the dataset has episodes {list(dataset.episodes)} "
                    f"and the guard is {self.guard} s."
                )
        known, unseen = dataset.rows(train), dataset.rows(test)
        again = repeated_rows((known.q, known.v, known.u), unseen)
        if again.size:
            seen = f"{again.size} of {len(unseen)} test rows are also training rows (the first: test row {again[0]})"
            raise DatasetError(f"{seen}. Test on another trajectory: another episode, recording or seed.")
        return known, unseen

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; None where a stretch goes to the end of the recording."""
        held_out = [
            {"episode": episode, "begin": None if math.isinf(begin) else begin, "end": None if math.isinf(end) else end}
            for episode, begin, end in self.held_out
        ]
        return {"name": self.name, "words": self.words, "held_out": held_out, "guard": self.guard}


MOST = 0.6  # of the rows, from which on an episode is too much to be held out, or to be learned from alone


@usable_arguments("split_named")
def split_named(dataset: Dataset, text: str, guard: float = 0.25) -> tuple[Split, ...]:
    """The splits of a text, as `forcegp score --split` takes it: several for leave-one-out, else one.

    auto: a quarter of the episodes, drawn at random; where one is `MOST` of the log, blocks 3 and 5 of five, or of each
        five of more blocks where a joint moves on one side alone.
    folds: the episodes in up to four random groups, each held out in turn; of more than `MANY` two, of one as auto.
    episodes:N,N...: whole episodes.
    leave-one-out: every episode once.
    blocks:N:K,K...: every episode is cut into N blocks of equal duration; those of these numbers, from 1, are held out,
        and training rows within `guard` seconds of them are left out.
    Raises InvalidInput for anything else, and where nothing would be held out or nothing left to learn from.
    """
    require_type("dataset", dataset, Dataset)
    known = [int(each) for each in dataset.episodes]
    alone = np.unique(dataset.episode, return_counts=True)[1].max() > MOST * len(dataset)
    kind, *parts = (_usual_blocks(dataset) if text in ("auto", "folds") and alone else text).split(":")
    try:
        match kind, [[int(word) for word in part.split(",")] for part in parts]:
            case "auto", []:
                drawn = np.random.default_rng(0).choice(known, size=max(round(0.25 * len(known)), 1), replace=False)
                return (_episodes_apart(known, sorted(drawn.tolist())),)
            case "folds", []:
                groups = np.array_split(np.random.default_rng(0).permutation(known), min(FOLDS, len(known)))
                held = groups if len(known) <= MANY else groups[:2]
                return tuple(_episodes_apart(known, sorted(group.tolist())) for group in held)
            case "leave-one-out", []:
                return tuple(_episodes_apart(known, [number]) for number in known)
            case "episodes", [chosen]:
                return (_episodes_apart(known, chosen),)
            case "blocks", [[count], chosen]:
                return (_blocks_apart(dataset, count, sorted(chosen), guard),)
            case _:
                pass
    except InvalidInput:
        raise
    except ValueError:
        pass  # a text where a number belongs
    raise InvalidInput(f"the split is {text!r}; give auto, {FORMS}, for example {DEFAULT_BLOCKS}.")


def _usual_blocks(dataset: Dataset) -> str:
    """Blocks of which both sides show the motion of every joint that moves."""
    text, power = DEFAULT_BLOCKS, np.square(dataset.v)
    for count in COUNTS:
        held = [number for number in range(1, count + 1) if number % 5 in (3, 0)]
        shares = power[_blocks_apart(dataset, count, held, 0.0).test_rows(dataset)].sum(0) / power.sum(0).clip(1e-300)
        text = f"blocks:{count}:{','.join(map(str, held))}"
        if ((shares >= SHOWN) & (shares <= 1.0 - SHOWN))[power.any(0)].all():
            return text
    return text


def _require_some(what: str, chosen: Sequence[int], known: Sequence[int]) -> None:
    if not set(chosen) < set(known) or len(set(chosen)) < len(chosen):
        raise InvalidInput(
            f"held-out {what} are {list(chosen)}; name some of {list(known)}, each once, and leave one to learn from, "
            f"or hold out blocks of time ({DEFAULT_BLOCKS})."
        )


def _episodes_apart(known: Sequence[int], episodes: Sequence[int]) -> Split:
    _require_some("episodes", episodes, known)
    sides = [listed([*map(str, each)]) for each in ([number for number in known if number not in episodes], episodes)]
    words = "trained on whole episodes ({}), tested on others ({})".format(*sides)
    held_out = tuple((number, -math.inf, math.inf) for number in episodes)
    return Split(f"episodes-{'-'.join(map(str, episodes))}", words, held_out)


def _blocks_apart(dataset: Dataset, blocks: int, numbers: Sequence[int], guard: float) -> Split:
    stretches = []
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
        f"{listed([*map(str, numbers)])} held out, and training rows within {guard:g} s of them left out"
    )
    return Split(f"blocks-{blocks}-{'-'.join(map(str, numbers))}", words, tuple(stretches), guard)


HORIZONS = (0.1, 0.2, 0.5, 1.0)
STARTS = 10


@dataclass(frozen=True, eq=False)
class HeldOutMotions:
    """The motions to predict: rows of held-out stretches without gaps, and numbers of those at which motions begin.

    The longest of the `horizons` [s] is how long they are; `notes` report what is missing.
    """

    horizons: tuple[float, ...] = ()
    stretches: tuple[tuple[Dataset, tuple[int, ...]], ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return sum(len(starts) for _, starts in self.stretches)

    def of(self, posterior: Posterior) -> tuple[Posterior, RecordedMotions]:
        """The posterior, and the motions with what its observers have seen before each of them.

        Its friction is known where these go on in the record that it was fitted to.
        """
        posterior = in_its_record(posterior, [float(rows.time.min()) for rows, _ in self.stretches])
        pairs = [observing(posterior, rows, whole=True) for rows, _ in self.stretches]
        own = zip(pairs, self.stretches, strict=True)
        each = [recorded_motions(seen, at, self.horizons[-1]) for (_, seen), (_, at) in own]
        return pairs[0][0], RecordedMotions.joined(each)


def held_out_motions(
    log: Dataset, held_out: Bool[np.ndarray, " rows"], horizons: Sequence[float] | None = None, starts: int = STARTS
) -> HeldOutMotions:
    """`starts` motions in every held-out stretch without gaps that lasts as long as the longest horizon.

    None takes those of `HORIZONS` that some stretch lasts for, with a note. Raises InvalidInput for others.
    """
    wanted = tuple(HORIZONS if horizons is None else horizons)
    if not all(isinstance(h, int | float) and 0.0 < h < np.inf for h in wanted):
        raise InvalidInput(f"horizons are {list(wanted)}; give positive numbers of seconds.")
    wanted, starts = tuple(sorted(set(wanted))), whole_number("starts", starts, 1)
    if not wanted:
        return HeldOutMotions()
    if not log.time_ordered:
        return HeldOutMotions(notes=("no motion was predicted: the rows are not in the order of time.",))
    stretches, step = stretches_without_gap(log, held_out), median_step(log)
    longest = max((float(np.ptp(log.time[rows])) for rows in stretches), default=0.0)
    possible, notes = tuple(h for h in wanted if step <= h <= longest * (1.0 + EVEN_STEPS)), list[str]()
    if len(possible) < len(wanted):
        left_out = ", ".join(f"{h:g} s" for h in wanted if h not in possible)
        notes.append(f"not predicted: {left_out}; held-out stretches last {longest:.3g} s at most, steps {step:.3g} s.")
        if horizons is not None:
            raise InvalidInput(f"horizons {notes[0]} Give shorter ones.")
    found = list[tuple[Dataset, tuple[int, ...]]]()
    for rows in stretches if possible else ():
        if np.ptp(log.time[rows]) >= possible[-1] * (1.0 - EVEN_STEPS):
            own = log.rows(rows)
            try:
                found.append((own, recorded_motions(own, starts, possible[-1]).rows))
            except InvalidInput as error:
                notes.append(f"motions of one stretch were left out: {error}")
    return HeldOutMotions(possible if found else (), tuple(found), tuple(dict.fromkeys(notes)))


def motion_scores(
    posterior: Posterior, held_out: HeldOutMotions, integrator: str = "rk4"
) -> tuple[Table, dict[str, Any] | None]:
    """`position after 0.5 s` and the like at every horizon, and what belongs to all of them; None without motions.

    `rmse` over the motions of q in rad or m, of a base in its own axes, and of v; `coverage_95` of q where there are
    intervals. `diverged` motions do not count. `squared` (horizons, motions) is the mean over joints for q.
    """
    if not len(held_out):
        return {}, None
    posterior, motions = held_out.of(posterior)
    start = motions.q[:, 0], motions.v[:, 0]
    rollout = predicted(posterior, *start, motions.u, motions.dt, integrator)
    recorded = torch.as_tensor(motions.q.copy(), device=rollout.q.device)
    off = rollout.steps_to(recorded)
    found = {"position": off, "velocity": torch.as_tensor(motions.v.copy(), device=rollout.q.device) - rollout.v}
    inside = None if rollout.intervals is None else rollout.contains(recorded)
    table: Table = {}
    facts: dict[str, Any] = {
        "horizons": list(held_out.horizons),
        "motions": len(motions.q),
        "integrator": rollout.integrator,
    }
    facts |= {"dt": motions.dt, "diverged": [], "squared": []}
    for horizon in held_out.horizons:
        row = round(horizon / motions.dt)
        lasting = torch.isfinite(off[:, row]).all(-1)
        for name, errors in found.items():
            here = errors[lasting, row].square().mean(0).sqrt()
            table[f"{name} after {horizon:g} s"] = {"rmse": plain(here.cpu().numpy())}
        if inside is not None:
            table[f"position after {horizon:g} s"]["coverage_95"] = plain(inside[lasting, row].mean(0).cpu().numpy())
        facts["diverged"].append(int((~lasting).sum()))
        facts["squared"].append(plain(off[:, row].square().mean(-1).cpu().numpy()))
    return table, facts
