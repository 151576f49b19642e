"""Contacts that act in some rows only: does the motion support what their flags say?"""

from collections.abc import Iterator

import numpy as np
import torch

from forcegp.checks.check_input import Finding, look, ok, wrong
from forcegp.data import Dataset
from forcegp.errors import ContactError
from forcegp.mechanics import MechanicalSystem

RESTING, MOVING = 0.02, 0.1
"""m/s: slower than the first stands, whatever noise; parts of the rms speed while free, above which it slides."""
MOST_ROWS = 4000
FEW = 0.05
"""Share of rows that may contradict their flag: those at touch-down and lift-off."""


def stance_findings(dataset: Dataset, system: MechanicalSystem) -> Iterator[Finding]:
    """Contacts that contradict each other; flags that are no flags; feet that move while standing, or rest while free.

    A foot that stands has A v = 0 in all directions that its contacts hold.
    """
    if not system.contacts:
        return
    every = -(-len(dataset) // MOST_ROWS)
    dataset = dataset.rows(slice(None, None, every))
    try:
        system.check_states(*(torch.tensor(x, device=system.robot.device) for x in (dataset.q, dataset.v, dataset.u)))
    except ContactError as error:
        counted = f" (rows are counted in every {every}. one)" if every > 1 else ""
        yield wrong(subject="contacts", seen=f"{error}{counted}")
    names = dict.fromkeys(contact.switch for contact in system.contacts if contact.switch is not None)
    if not names:
        return
    q, v, u = (torch.tensor(x, device=system.robot.device) for x in (dataset.q, dataset.v, dataset.u))
    places = {name: system.inputs.index(name) for name in names}
    held = u.clone()
    held[:, list(places.values())] = 1.0
    with torch.no_grad():
        motion = (system.dynamics(q, v, held).A @ v[..., None])[..., 0].cpu().numpy()
    for name, place in places.items():
        flags = dataset.u[:, place]
        rows = [index for index, contact in enumerate(system.contacts) if contact.switch == name]
        speed, stands = np.linalg.norm(motion[:, rows], axis=1), flags > 0.5
        odd = int(((flags != 0.0) & (flags != 1.0)).sum())
        if odd:
            yield wrong(
                subject="contact flag",
                seen=f"{name!r} is neither 0 nor 1 in {odd} of {len(flags)} rows; above .5 it counts as 1.",
                remedy="Write 1 where the contact holds and 0 elsewhere, for example force > threshold.",
                numbers={"rows": odd},
            )
        free = float(np.sqrt(np.square(speed[~stands]).mean())) if (~stands).any() else 0.0
        limit = max(RESTING, MOVING * free)
        sliding = float((speed[stands] > limit).mean()) if stands.any() else 0.0
        resting = float((speed[~stands] < 0.1 * limit).mean()) if (~stands).any() else 0.0
        numbers = {"standing": float(stands.mean()), "moving while standing": sliding, "limit": limit}
        if sliding > FEW:
            worst = int(np.flatnonzero(stands)[speed[stands].argmax()])
            row = every * worst
            yield wrong(
                subject="contact flag",
                seen=f"{name!r} holds {system.contacts[rows[0]].frame!r} in rows in which it moves: {sliding:.0%} of "
                f"them are faster than {limit:.2g} m/s, row {row} with {speed[worst]:.2g} m/s.",
                remedy="Set the flag to 0 where the foot slides or is lifted, and compare its time with that of the "
                "joints; a wrong foot point or joint offset shows the same.",
                numbers=numbers,
            )
        elif resting > 0.5:
            yield look(
                subject="contact flag",
                seen=f"{name!r} is 0 in rows of which {resting:.0%} show {system.contacts[rows[0]].frame!r} at rest.",
                remedy="A foot at rest may stand: compare the flag with contact forces or heights.",
                numbers={**numbers, "resting": resting},
            )
        elif not odd:
            yield ok(subject="contact flag", seen=f"{name!r} agrees with the motion.", numbers=numbers)


def unmeasured_base_findings(dataset: Dataset, system: MechanicalSystem) -> Iterator[Finding]:
    """A base whose columns hold one number while joints move: nobody measured it."""
    for group in system.robot.layout.groups:
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
