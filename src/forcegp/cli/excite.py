"""`forcegp excite`: choose the next motion of a robot, the one that teaches most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
from forcegp.cli.command import MODEL, NUMBERS, Command, begins, listed, numbers_of, unless_given
from forcegp.cli.robot_options import CONTACTS, RobotOptions, parse_contacts
from forcegp.cli.terminal import Terminal, columns
from forcegp.errors import InvalidInput
from forcegp.scores.tables import number


@dataclass(frozen=True, kw_only=True)
class Excite(Command):
    """Choose the motion within limits, from rest to rest, that reduces the uncertainty of learned forces most.

    With --robot instead of a model, one that identifies base parameters and friction.

    For example:
      forcegp excite run --limits velocity=1.5,acceleration=6 --out next.csv
      forcegp excite --robot arm.urdf --limits velocity=1,1,2 --seconds 20 --out next.csv
    """

    model: Annotated[Positional[Path | None], MODEL, arg(metavar="[RUN]")] = None
    """The folder that `forcegp fit --out` wrote."""
    out: Annotated[Path, arg(metavar="FILE.csv")]
    """t, q, v, a and u to write, 100 rows per second, as `forcegp import` reads them."""
    seconds: Annotated[float, arg(metavar="S")] = 10.0
    """How long the motion lasts."""
    limits: Annotated[
        tuple[str, ...], listed(goes_on=NUMBERS), unless_given("WHAT=X[,X...],...", "the robot file's")
    ] = ()
    """Largest position (from the start), velocity, acceleration or torque, for all joints or for each. Of the limits of
    the robot file nine tenths are used."""
    posture: Annotated[
        tuple[float, ...], listed(float), unless_given("Q,...", "mean of the log, or middle of the ranges")
    ] = ()
    """Positions of the joints at both ends."""
    avoid: Annotated[tuple[str, ...], listed(goes_on=NUMBERS), unless_given(CONTACTS, "its contacts")] = ()
    """Surfaces that points of the robot must not touch, as in `forcegp fit --contact`; or none."""
    clearance: Annotated[float, arg(metavar="M")] = 0.05
    """How far the points of --avoid stay away, in m."""
    tries: Annotated[int, arg(metavar="N")] = 300
    """How many motions to look at."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the motions that are looked at."""
    robot: RobotOptions = RobotOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Choose, write, draw and show."""
        self.require_free_file(self.out, begins(b"t,q_"), "a motion of forcegp")
        model, limits = self.robot.chosen(), {}
        if (model is None) == (self.model is None):
            raise InvalidInput("give either the folder of a fitted model or --robot ARM.urdf.")
        for word in self.limits:
            name, _, values = word.partition("=")
            numbers = numbers_of(values, f"--limits {word}: give numbers, for example --limits velocity=1.5.")
            limits[name] = numbers[0] if len(numbers) == 1 else numbers
        given = {name: getattr(self, name) for name in ("seconds", "clearance", "seed")}
        with terminal.progress(f"choosing a motion of {self.seconds:g} s") as report:
            chosen = forcegp.excitation(
                model or forcegp.load_posterior(str(self.model)),
                **given,
                motions=self.tries,
                limits=limits,
                start=list(self.posture) or None,
                surfaces=parse_contacts(self.avoid) if self.avoid else None,
                progress=report,
            )
        chosen.save_csv(self.out)
        usage = {name: values.tolist() for name, values in chosen.usage.items()}
        table = {f"{name}\nover limit": values for name, values in usage.items()}
        spread = None if chosen.spread is None else chosen.spread.tolist()
        if spread is not None:
            table |= {"spread of a,\nbefore": spread[0], "\nafter": spread[1]}
        rows = [
            [name, *map(number, each)] for name, *each in zip(chosen.robot.joint_names, *table.values(), strict=True)
        ]
        terminal.show(columns(str(self.out), ["joint", *table], rows))
        return {"out": str(self.out), "usage": usage, "spread": spread, "condition": chosen.condition}
