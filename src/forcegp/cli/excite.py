"""`forcegp excite`: choose the next motion of a robot, the one that teaches most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.scores
from forcegp.cli.command import DATASET, MODEL, NUMBERS, URDF, Overwriting, begins, listed, numbers_of, unless_given
from forcegp.cli.contact_syntax import CONTACTS, parse_contacts
from forcegp.cli.input_options import RobotOptions
from forcegp.cli.terminal import Terminal, columns, number
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Excite(RobotOptions, Overwriting):
    """Choose the motion within limits, from rest to rest, that reduces the uncertainty of learned forces most.

    With --robot instead of a model, one that identifies base parameters and friction.

    For example:
      forcegp excite run --limits velocity=1.5,acceleration=6 --out next.csv
      forcegp excite --robot arm.urdf --limits velocity=1,1,2 --seconds 20 --out next.csv
    """

    run_folder: Annotated[Positional[Path | None], MODEL, arg(metavar="[RUN]")] = None
    """The folder that `forcegp fit --out` wrote."""
    robot: Annotated[Path | None, URDF, unless_given("ARM.urdf", "the model's", Path)] = None
    """A robot of which nothing was learned, instead of a model."""
    out: Annotated[Path, arg(metavar="FILE.csv")]
    """t, q, v, a and u to write, 100 rows per second, as `forcegp import` reads them; and a picture, FILE.png."""
    seconds: Annotated[float, arg(metavar="S")] = 10.0
    """How long the motion lasts."""
    limits: Annotated[tuple[str, ...], listed("WHAT=X[,X...],...", goes_on=NUMBERS)] = ()
    """Largest position (from the start), velocity, acceleration or torque, for all joints or for each."""
    limit_share: Annotated[float, arg(metavar="PART")] = 0.9
    """The part of the URDF's own limits that may be used."""
    posture: Annotated[tuple[float, ...], listed("Q,...", "mean of the log, or middle of the ranges", of=float)] = ()
    """Positions of the joints at both ends."""
    avoid: Annotated[tuple[str, ...], listed(CONTACTS, "its contacts", goes_on=NUMBERS)] = ()
    """Surfaces that points of the robot must not touch, as in `forcegp fit --contact`; or none."""
    clearance: Annotated[float, arg(metavar="M")] = 0.05
    """How far the points of --avoid stay away, in m."""
    task: Annotated[Path | None, DATASET, unless_given("DATA", "all within the limits", Path)] = None
    """A log with the states at which forces should be certain (HDF5)."""
    tries: Annotated[int, arg(metavar="N")] = 300
    """How many motions to look at."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the motions that are looked at."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Choose, write, draw and show."""
        picture = self.out.with_suffix(".png")
        for path, mark in ((self.out, b"t,q_"), (picture, b"\x89PNG")):
            self.require_free_file(path, begins(mark), "what forcegp writes there")
        model, limits = self.chosen(), {}
        if (model is None) == (self.run_folder is None):
            raise InvalidInput("give either the folder of a fitted model or --robot ARM.urdf.")
        for word in self.limits:
            name, _, values = word.partition("=")
            numbers = numbers_of(values, f"--limits {word}: give numbers, for example --limits velocity=1.5.")
            limits[name] = numbers[0] if len(numbers) == 1 else numbers
        given = {name: getattr(self, name) for name in ("seconds", "clearance", "seed")}
        with terminal.progress(f"choosing a motion of {self.seconds:g} s") as report:
            chosen = forcegp.excitation(
                model or forcegp.load_posterior(str(self.run_folder)),
                **given,
                margin=self.limit_share,
                motions=self.tries,
                limits=limits,
                start=list(self.posture) or None,
                surfaces=parse_contacts(self.avoid) if self.avoid else None,
                task=None if self.task is None else forcegp.Dataset.load(self.task),
                progress=report,
            )
        chosen.save_csv(self.out)
        forcegp.scores.save_figure(forcegp.scores.excitation_figure(chosen), picture)
        terminal.note(f"figure: {picture}")
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
