"""Contacts that act in some rows only: does the motion support what their flags say?"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from forcegp.checks.check_input import Finding, listed, look, ok, wrong
from forcegp.data import Dataset, estimate_stance
from forcegp.data.gravity import missing_gravity
from forcegp.data.stance import TILTS, tilting
from forcegp.errors import ContactError
from forcegp.model import Model

MOST_ROWS = 4000
FEW, RARE, RESTING = 0.05, 0.002, 0.02
"""Shares of rows of stance that the motion contradicts and that are wrong, or worth a look; the same of swing."""


def stance_findings(dataset: Dataset, model: Model) -> Iterator[Finding]:
    """Contacts that contradict each other; flags that are no flags, or that `estimate_stance` contradicts."""
    if not model.contacts:
        return
    every = -(-len(dataset) // MOST_ROWS)
    dataset = dataset.rows(slice(None, None, every))
    try:
        model.check_states(*(torch.tensor(x, device=model.robot.device) for x in (dataset.q, dataset.v, dataset.u)))
    except ContactError as error:
        counted = f" (rows are counted in every {every}. one)" if every > 1 else ""
        yield wrong(subject="contacts", seen=f"{error}{counted}")
    names = dict.fromkeys(contact.switch for contact in model.contacts if contact.switch is not None)
    if not names:
        return
    if missing_gravity(dataset, model) is not None:  # another finding, without which forces show nothing
        return
    found = estimate_stance(dataset, model)
    leans = tilting(dataset, model, found.names, dataset.u[:, [model.inputs.index(name) for name in found.names]])
    shared = {name: finding for name in found.names for finding in _shared_flag(dataset, model, name, every)}
    yield from shared.values()
    for k, name in enumerate(found.names):
        if name in shared:
            continue
        logged, shown, speed = dataset.u[:, model.inputs.index(name)], found.flags[:, k], found.speed[:, k]
        frame = next(contact.frame for contact in model.contacts if contact.switch == name)
        stands = logged > 0.5
        leaning = float(leans[:, k].sum() / max(stands.sum(), 1))
        if leaning > FEW:
            yield wrong(
                subject="contact flag",
                seen=f"{frame!r}, which is held flat, leans by more than {TILTS:g} rad in {leaning:.0%} of the rows in "
                f"which {name!r} is 1, row {every * int(np.flatnonzero(leans[:, k])[0])} for example: its heel or "
                "toe turns.",
                remedy="forcegp prepare log.h5 --stance auto --out data.h5 leaves these rows out; for a foot that is "
                "never flat give the point that it stands on, --feet FRAME@x,y,z.",
                numbers={"leaning": leaning},
            )
        odd = int(((logged != 0.0) & (logged != 1.0)).sum())
        if odd:
            yield wrong(
                subject="contact flag",
                seen=f"{name!r} is neither 0 nor 1 in {odd} of {len(logged)} rows; above .5 it counts as 1.",
                remedy="Write 1 where the contact holds and 0 elsewhere, for example force > threshold.",
                numbers={"rows": odd},
            )
        lifted, resting = stands & ((shown == 0.0) | found.moves[:, k]), ~stands & (shown == 1.0)
        sliding, rests = (float(x.sum() / max(y.sum(), 1)) for x, y in ((lifted, stands), (resting, ~stands)))
        numbers = {"standing": float(stands.mean()), "moving while standing": sliding, "resting while free": rests}
        numbers |= {"limit": float(found.slow[k]), "open": float(np.isnan(shown).mean())}
        if sliding > RARE:
            worst = int(np.flatnonzero(lifted)[speed[lifted].argmax()])
            yield (wrong if sliding > FEW else look)(
                subject="contact flag",
                seen=f"{name!r} holds {frame!r} in rows in which it moves or bears nothing: {sliding:.1%} of them, row "
                f"{every * worst} with {speed[worst]:.2g} m/s and {found.force[worst, k]:.2g} N.",
                remedy="Set the flag to 0 where the foot slides or is lifted (forcegp prepare --stance auto finds such "
                "rows), and compare its time with that of the joints; a wrong foot point or joint offset shows the "
                "same.",
                numbers=numbers,
            )
        elif rests > RESTING:
            row = every * int(np.flatnonzero(resting)[0])
            yield look(
                subject="contact flag",
                seen=f"{name!r} is 0 in rows of which {rests:.0%} show {frame!r} at rest, row {row} for example.",
                remedy="A foot at rest may stand: compare the flag with contact forces or heights.",
                numbers=numbers,
            )
        elif not odd:
            yield ok(subject="contact flag", seen=f"{name!r} agrees with motion and forces.", numbers=numbers)


def _shared_flag(dataset: Dataset, model: Model, name: str, every: int) -> Iterator[Finding]:
    """Feet of this flag of which only some stand, by flags of their own."""
    frames = list(dict.fromkeys(contact.frame for contact in model.contacts if contact.switch == name))
    if len(frames) < 2:
        return
    own = {frame: f"{name} {frame}" for frame in frames}
    contacts = [replace(each, switch=own[each.frame]) if each.switch == name else each for each in model.contacts]
    apart = model.with_contacts(contacts)
    places = [model.inputs.index(x if x in model.inputs else name) for x in apart.inputs]
    found = estimate_stance(replace(dataset, model=apart, u=dataset.u[:, places], truth={}))
    flags = found.flags[:, [found.names.index(switch) for switch in own.values()]]
    some = (flags == 1.0).any(axis=1) & (flags == 0.0).any(axis=1)
    if some.mean() > FEW:
        row = int(np.flatnonzero(some)[0])
        standing = listed([repr(frame) for frame, flag in zip(frames, flags[row], strict=True) if flag == 1.0])
        yield wrong(
            subject="contact flag",
            seen=f"{name!r} is the flag of {listed(list(map(repr, frames)))}, of which only some stand in "
            f"{some.mean():.0%} of the rows, row {every * row} for example: {standing} alone.",
            remedy=f"Give each foot a flag of its own, as forcegp import --feet {','.join(frames)} does (FRAME:flat "
            "for flat feet): without columns for them, it finds the flags.",
            numbers={"apart": float(some.mean())},
        )


def gravity_findings(dataset: Dataset, model: Model) -> Iterator[Finding]:
    """A robot in a vertical plane that was read without gravity in it."""
    found = missing_gravity(dataset, model)
    if found is not None:
        yield wrong(subject="gravity", seen=f"{found[0]}.", remedy=found[1])


def unmeasured_base_findings(dataset: Dataset, model: Model) -> Iterator[Finding]:
    """A base whose columns hold one number while joints move: nobody measured it."""
    for group in model.robot.layout.groups:
        others = np.delete(np.arange(dataset.nv), np.arange(group.rows.start, group.rows.stop))
        still = not np.ptp(dataset.q[:, group.places], axis=0).any() and not dataset.v[:, group.rows].any()
        moves = not len(others) or np.ptp(dataset.v[:, others], axis=0).any()
        if still and moves and len(dataset) > 1:
            yield wrong(
                subject="base",
                seen=f"{group.name!r} stands still in all {len(dataset)} rows to the last digit: it was not measured.",
                remedy="Record its pose by motion capture or a state estimator (position and quaternion), and its "
                "velocity. Without, learn joint friction on a stand: base='fixed'.",
            )
