"""Contacts that act in some rows only: does the motion support what their flags say?"""

from collections.abc import Iterator

import numpy as np
import torch

from forcegp.data import Dataset, estimate_stance
from forcegp.data.stance import missing_gravity
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.errors import ContactError
from forcegp.model import Model

MOST_ROWS = 4000
FEW, RARE, RESTING = 0.05, 0.002, 0.02
"""Shares of rows of stance that the motion contradicts and that are wrong, or worth a look; the same of swing."""


def stance_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """Contacts that contradict each other; flags that are no flags, or that `estimate_stance` contradicts."""
    if not model.contacts:
        return
    every = -(-len(dataset) // MOST_ROWS)
    dataset = dataset.rows(slice(None, None, every))
    try:
        model.check_states(*(torch.tensor(x, device=model.robot.device) for x in (dataset.q, dataset.v, dataset.u)))
    except ContactError as error:
        counted = f" (rows are counted in every {every}. one)" if every > 1 else ""
        yield wrong(about="contacts", what=f"{error}{counted}")
    names = dict.fromkeys(contact.switch for contact in model.contacts if contact.switch is not None)
    if not names:
        return
    if missing_gravity(dataset, model) is not None:  # another doubt, without which forces show nothing
        return
    found = estimate_stance(dataset, model)
    for k, name in enumerate(found.names):
        logged, shown, speed = dataset.u[:, model.inputs.index(name)], found.flags[:, k], found.speed[:, k]
        frame = next(contact.frame for contact in model.contacts if contact.switch == name)
        stands = logged > 0.5
        odd = int(((logged != 0.0) & (logged != 1.0)).sum())
        if odd:
            yield wrong(
                about="contact flag",
                what=f"{name!r} is neither 0 nor 1 in {odd} of {len(logged)} rows; above .5 it counts as 1.",
                do="Write 1 where the contact holds and 0 elsewhere, for example force > threshold.",
                numbers={"rows": odd},
            )
        lifted, resting = stands & ((shown == 0.0) | found.moves[:, k]), ~stands & (shown == 1.0)
        sliding, rests = (float(x.sum() / max(y.sum(), 1)) for x, y in ((lifted, stands), (resting, ~stands)))
        numbers = {"standing": float(stands.mean()), "moving while standing": sliding, "resting while free": rests}
        numbers |= {"limit": float(found.slow[k]), "open": float(np.isnan(shown).mean())}
        kind, seen, remedy = ok, f"{name!r} agrees with motion and forces.", ""
        if sliding > RARE:
            row = int(np.flatnonzero(lifted)[speed[lifted].argmax()])
            kind = wrong if sliding > FEW else look
            seen = (
                f"{name!r} holds {frame!r} in rows in which it moves or bears nothing: {sliding:.1%} of them, row "
                f"{every * row} with {speed[row]:.2g} m/s and {found.force[row, k]:.2g} N."
            )
            remedy = (
                "Set the flag to 0 where the foot slides or is lifted (forcegp import --stance auto finds such rows), "
                "and compare its time with that of the joints; a wrong foot point or joint offset shows the same."
            )
        elif rests > RESTING:
            row = every * int(np.flatnonzero(resting)[0])
            kind, remedy = look, "A foot at rest may stand: compare the flag with contact forces or heights."
            seen = f"{name!r} is 0 in rows of which {rests:.0%} show {frame!r} at rest, row {row} for example."
        if kind is not ok or not odd:
            yield kind(about="contact flag", what=seen, do=remedy, numbers=numbers)


def gravity_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """A robot in a vertical plane that was read without gravity in it."""
    found = missing_gravity(dataset, model)
    if found is not None:
        yield wrong(about="gravity", what=f"{found[0]}.", do=found[1])


def unmeasured_base_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """A base whose columns hold one number while joints move: nobody measured it."""
    for group in model.robot.layout.groups:
        others = np.delete(np.arange(dataset.nv), np.arange(group.rows.start, group.rows.stop))
        still = not np.ptp(dataset.q[:, group.places], axis=0).any() and not dataset.v[:, group.rows].any()
        moves = not len(others) or np.ptp(dataset.v[:, others], axis=0).any()
        if still and moves and len(dataset) > 1:
            yield wrong(
                about="base",
                what=f"{group.name!r} stands still in all {len(dataset)} rows to the last digit: it was not measured.",
                do="Record its pose by motion capture or a state estimator (position and quaternion), and its "
                "velocity. Without, learn joint friction on a stand: base='fixed'.",
            )
