"""`forcegp export`, `monitor` and `excite`: what is done with a fitted model."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.posterior
import forcegp.scores
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, MODEL, NUMBERS, Command, listed, numbers_of, unless_given
from forcegp.cli.fit import warn_of_wrong
from forcegp.cli.robot_options import CONTACTS, RobotOptions, parse_contacts, require_same_joints
from forcegp.cli.terminal import Terminal, columns, doubts_table, shown
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class AlarmOptions:
    """When a monitor reports that something touches the robot."""

    false_alarms: Annotated[float, arg(metavar="N")] = 0.1
    """Accepted false alarms per hour."""
    bandwidth: Annotated[float, arg(metavar="HZ")] = 2.0
    """Cut-off of the low-pass filter on the torques. A higher one is faster, a lower one finds smaller forces."""

    def monitor(self, predictor: Any, free: Sequence[Any], dt: float) -> forcegp.ContactMonitor:
        """Calibrated on free motion of steps of `dt` s."""
        monitor = forcegp.ContactMonitor(predictor, dt=dt, bandwidth=self.bandwidth)
        return monitor.calibrate([each[1:] for each in free], false_alarms_per_hour=self.false_alarms)


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a fitted model as a program that needs no Python.

    c: C99 with the weights inside and <math.h> only, headers for C and C++17, an example, a self-test, a
    CMakeLists.txt. It computes accelerations, the torques for a wanted motion, every force by itself, and what friction
    remembers. It is compiled and compared with the model before it is there.
    casadi: CasADi functions with all derivatives, for casadi.Function.load (pip install 'forcegp[casadi]').

    For example:
      forcegp export run --to c --out deployed --covariance
      forcegp export run --to casadi --out planner --steps 0.02
      forcegp export run --to c --out mpc --jacobian --steps 0.02 --integrator implicit-midpoint
      forcegp export run --to c --out watch --free morning.h5
    """

    model: Annotated[Positional[Path], MODEL, arg(metavar="RUN")]
    """The folder that `forcegp fit --out` wrote."""
    to: Literal["c", "casadi"]
    """What to write."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write."""
    covariance: bool = False
    """With the covariance of the acceleration, which makes the program some 2 MB larger."""
    jacobian: bool = False
    """With derivatives in q, v and u. Compilers take some ten seconds for them."""
    steps: Annotated[float | None, unless_given("DT", "without", float)] = None
    """With x+ = f(x, u), a step of DT seconds."""
    integrator: Annotated[str | None, unless_given("NAME", "symplectic-euler", str)] = None
    """How the step of --steps is computed: symplectic-euler, rk4 or implicit-midpoint (stiff friction)."""
    unchecked: bool = False
    """Do not compile the program and compare it with the model."""
    free: Annotated[str | None, unless_given("FREE.h5", "no monitor", str)] = None
    """With a monitor of contacts, called at the rate of this log: 40 s or more of free motion, not learned from."""
    alarms: AlarmOptions = AlarmOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Write and show."""
        if self.integrator is not None and self.steps is None:
            raise InvalidInput("--integrator was given without --steps, which sets the length of a step.")
        self.require_free(self.out)
        posterior = forcegp.load_posterior(self.model)
        names = ("to", "covariance", "jacobian", "steps", "integrator")
        content = {"run": str(self.model), **{name: getattr(self, name) for name in names}}
        with self.folder(self.out, content) as folder:
            found = TARGETS[self.to](self, terminal, posterior, folder)
        return {"out": str(self.out), **content, **found}


def _c(options: Export, terminal: Terminal, posterior: Any, folder: Path) -> dict[str, Any]:
    given = {name: getattr(options, name) for name in ("covariance", "jacobian", "steps", "unchecked")}
    given |= {"integrator": options.integrator or "symplectic-euler", "source": str(options.model)}
    if options.free is not None:
        free, dt = _motions(terminal, Path(options.free), posterior)
        with terminal.progress("calibrating"):
            predictor = posterior.predictor(covariance="compressed" if options.covariance else "none")
            given["monitor"] = monitor = options.alarms.monitor(predictor, free, dt)
        terminal.show(doubts_table(monitor.doubts, terminal.worded))
    made = forcegp.export_c(posterior, folder, **given)
    sizes = [[file, f"{size:,}"] for file, size in made.files.items()]
    terminal.show(columns(str(options.out), ["file", "bytes"], sizes))
    for function, apart in made.differences.items():
        terminal.show(f"{function}: at most {apart:.1e} of the largest value from forcegp's own")
    return {"name": made.name, "files": made.files, "differences": made.differences, "inflation": made.inflation}


def _casadi(options: Export, terminal: Terminal, posterior: Any, folder: Path) -> dict[str, Any]:
    for name in ("covariance", "jacobian", "unchecked", "free"):
        if getattr(options, name):
            raise InvalidInput(f"--{name} is for --to c; CasADi functions have all derivatives, and no covariance.")
    given = {"steps": options.steps, "integrator": options.integrator or "symplectic-euler"}
    differences = forcegp.posterior.export_casadi(posterior, folder, **given)
    rows = [[file, f"{apart:.1e}"] for file, apart in differences.items()]
    terminal.show(columns(str(options.out), ["file", "largest difference / largest value"], rows))
    return {"differences": differences}


TARGETS: dict[str, Callable[[Export, Terminal, Any, Path], dict[str, Any]]] = {"c": _c, "casadi": _casadi}
"""What writes each target to a folder; a new one is a function here and a name in `Export.to`."""
PLACE = tuple(f"{name}_{axis}" for name in ("point", "force", "force_std") for axis in "xyz")
COLUMNS = ("start", "end", "peak", "probability", "link", "also", "newton", *PLACE)
APART = 0.25  # alarms that are less apart in s belong to one contact


@dataclass(frozen=True, kw_only=True)
class Monitor(Command):
    """Find contacts in a log without a force sensor: time, link and force of each.

    A residual torque counts as a contact if it exceeds what free motion of the same robot shows.
    LOG is a dataset; forcegp import makes one of any log.

    For example:
      forcegp monitor run log.h5 --free 120 --out contacts
      forcegp monitor run shift.h5 --free morning.h5 --false-alarms 0.01 --out contacts
    """

    model: Annotated[Positional[Path], MODEL, arg(metavar="RUN")]
    """The folder that `forcegp fit --out` wrote, of a robot without contacts."""
    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The log to search, at the rate of its sensors."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write, with contacts.json."""
    free: Annotated[str, arg(metavar="S|FREE.h5")]
    """Motion without contacts, 40 s or more, not learned from: S seconds of LOG (not searched), or another log."""
    alarms: AlarmOptions = AlarmOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Calibrate, look and show."""
        try:
            seconds, other = float(self.free), None
        except ValueError:
            seconds, other = 1.0, Path(self.free)
        if not (seconds > 0.0 and (other is None or other.is_file())):
            raise InvalidInput(f"--free is {self.free}; give seconds above 0, or a dataset that is there (.h5).")
        self.require_free(self.out)
        posterior = forcegp.load_posterior(self.model)
        motions, dt = _motions(terminal, self.log, posterior)
        if other is not None:
            known, _ = _motions(terminal, other, posterior, dt)
        else:
            first, rows = motions[0], round(min(seconds / dt, float(len(motions[0][0]))))
            known, motions[0] = [tuple(x[:rows] for x in first)], tuple(x[rows:] for x in first)
        with terminal.progress("looking"):
            monitor = self.alarms.monitor(posterior.predictor(), known, dt)
            parts = [(time, q, monitor.run(q, v, u)) for time, q, v, u in motions if len(time) > 1]
        if not parts:
            raise InvalidInput(f"nothing is left of {self.log} after --free {self.free}.")
        least = monitor.smallest_forces([row for _, q, _ in parts for row in q])
        contacts = [found for time, q, state in parts for found in _contacts(monitor, time, q, state)]
        content = {"run": str(self.model), "log": str(self.log), "free": self.free, **vars(self.alarms), "dt": dt}
        content |= {"threshold": monitor.threshold, "seconds": sum(len(time) for time, *_ in parts) * dt}
        finite = {link: [x if math.isfinite(x) else None for x in each] for link, each in least.items()}
        content |= {"smallest_forces": finite, "doubts": [doubt.to_dict() for doubt in monitor.doubts]}
        title = f"{self.log.name}: {len(contacts)} contacts in {content['seconds']:.0f} s"
        with self.folder(self.out, content) as folder:
            write_json(folder / "contacts.json", {**content, "contacts": contacts})
        header = ["on", "from [s]", "to [s]", "force [N]", "distance /\nthreshold"]
        three = [[f"{each[name]:.2f}" for name in ("start", "end", "newton")] for each in contacts]
        ratios = [f"{each['peak'] / monitor.threshold:.1f}" for each in contacts]
        rows = [[each["link"], *own, x] for each, own, x in zip(contacts, three, ratios, strict=True)]
        found = columns(title, header, rows) if rows else title
        felt = [[link, *(shown(x, "{:.2g}") for x in each)] for link, each in finite.items()]
        header = ["at the end of", "along the best axis [N]", "along any [N]"]
        seen = columns("smallest forces that it finds", header, felt)
        terminal.show(found, seen, doubts_table(monitor.doubts, terminal.worded))
        return {**content, "contacts": contacts}


def _motions(
    terminal: Terminal, path: Path, posterior: Any, dt: float | None = None
) -> tuple[list[tuple[Any, ...]], float]:
    """time, q, v and u of every episode, and their step, that of the first one.

    Raises InvalidInput for other joints than those of the model, and steps other than `dt`, where that is given.
    """
    dataset, motions = forcegp.Dataset.load(path), []
    require_same_joints(posterior, dataset, path)
    warn_of_wrong(terminal, path, dataset, posterior.model)
    for episode in dataset.episodes:
        at = dataset.episode == episode
        step = forcegp.data.filters.uniform_step(dataset.time[at], f"episode {episode} of {path}")
        dt = dt or step
        if abs(step - dt) > 0.01 * dt:
            raise InvalidInput(f"{path} has steps of {step:.4g} s and not of {dt:.4g} s; import all at one --rate.")
        motions.append((dataset.time[at], dataset.q[at], dataset.v[at], dataset.u[at]))
    return motions, dt or 0.0


def _contacts(monitor: forcegp.ContactMonitor, time: Any, q: Any, state: Any) -> Iterator[dict[str, Any]]:
    """Alarms that follow each other closely, as one contact with the place and the force of its peak."""
    import numpy as np  # here, so that --help does not wait for it

    alarms, distance = np.flatnonzero(state.alarm.numpy()), state.distance.numpy()
    for rows in np.split(alarms, np.flatnonzero(np.diff(alarms) * monitor.dt > APART) + 1) if alarms.size else ():
        peak = int(rows[distance[rows].argmax()])
        place = monitor.place(q[peak], state.torque[peak])
        ends = float(time[rows[0]]), float(time[rows[-1]]), float(distance[peak]), float(state.probability[peak])
        three = [x for name in ("point", "force", "force_std") for x in getattr(place, name)]
        found = (*ends, place.link, " ".join(place.also), float(np.linalg.norm(place.force)), *three)
        yield dict(zip(COLUMNS, found, strict=True))


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
    limits: Annotated[tuple[str, ...], listed(goes_on=NUMBERS), unless_given("WHAT=X,...", "the robot file's")] = ()
    """Largest position (from the start), velocity, acceleration, torque, of all or each; default: .9 of limits."""
    posture: Annotated[tuple[float, ...], listed(float), unless_given("Q,...", "middle of log or ranges")] = ()
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
        self.require_free_file(self.out, _is_motion, "a motion of forcegp")
        model, limits = self.robot.chosen(), {}
        if (model is None) == (self.model is None):
            raise InvalidInput("give either the folder of a fitted model or --robot ARM.urdf.")
        for word in self.limits:
            name, _, values = word.partition("=")
            numbers = numbers_of(values, f"--limits {word}: give numbers, for example --limits velocity=1.5.")
            limits[name] = numbers[0] if len(numbers) == 1 else numbers
        given = {name: getattr(self, name) for name in ("seconds", "clearance", "seed")}
        given |= {"motions": self.tries, "limits": limits, "start": list(self.posture) or None}
        given["surfaces"] = parse_contacts(self.avoid) if self.avoid else None
        with terminal.progress(f"choosing a motion of {self.seconds:g} s"):
            chosen = forcegp.excitation(model or forcegp.load_posterior(str(self.model)), **given)
        chosen.save_csv(self.out, overwrite=self.overwrite)
        usage = {name: values.tolist() for name, values in chosen.usage.items()}
        table = {f"{name}\nover limit": [x or None for x in values] for name, values in usage.items()}
        spread = None if chosen.spread is None else chosen.spread.tolist()
        if spread is not None:
            table |= {"spread of a,\nbefore": spread[0], "\nafter": spread[1]}
        of_joints = zip(chosen.robot.joint_names, *table.values(), strict=True)
        rows = [[name, *map(forcegp.scores.number, each)] for name, *each in of_joints]
        terminal.show(columns(str(self.out), ["joint", *table], rows))
        return {"out": str(self.out), "usage": usage, "spread": spread, "condition": chosen.condition}


def _is_motion(path: Path) -> bool:
    """Whether `Excite` wrote this: the same columns, 100 rows per second, from rest to rest at one posture."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.reader(file)
            header, *table = next(rows), next(rows), next(rows), *deque(rows, 1)
        first, second, last = ([float(text) for text in row] for row in table)
    except (ValueError, StopIteration, csv.Error):
        return False
    joints = [name[2:] for name in header if name.startswith("q_")]
    q, rest = slice(1, 1 + len(joints)), slice(1 + len(joints), 1 + 3 * len(joints))
    moves = any(first[rest] + last[rest]) or math.dist(first[q], last[q]) > 1e-6
    named = header == ["t", *(f"{what}_{joint}" for what in "qvau" for joint in joints)]
    return named and not moves and [first[0], second[0]] == [0.0, 0.01]
