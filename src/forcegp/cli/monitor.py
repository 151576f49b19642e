"""`forcegp monitor`: when a robot was touched, where and how hard, from its log and a fitted model."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.scores
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, MODEL, Command
from forcegp.cli.robot_options import require_same_joints
from forcegp.cli.terminal import Terminal, columns
from forcegp.errors import InvalidInput

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
    """The folder to write: contacts.csv, contacts.json and contacts.png."""
    free: Annotated[str, arg(metavar="S|FREE.h5")]
    """Motion of 40 s or more without contacts, not used for training: the first S seconds of LOG, which are not
    searched, or another log."""
    false_alarms: Annotated[float, arg(metavar="N")] = 0.1
    """Accepted false alarms per hour."""
    bandwidth: Annotated[float, arg(metavar="HZ")] = 5.0
    """Cut-off of the low-pass filter on the torques. A higher one is faster, a lower one finds smaller forces."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Calibrate, look, draw and show."""
        try:
            seconds, other = float(self.free), None
        except ValueError:
            seconds, other = 1.0, Path(self.free)
        if not (seconds > 0.0 and (other is None or other.is_file())):
            raise InvalidInput(f"--free is {self.free}; give seconds above 0, or a dataset that is there (.h5).")
        self.require_free(self.out)
        posterior = forcegp.load_posterior(self.model)
        log = _dataset(self.log, posterior)
        dt = forcegp.data.filters.uniform_step(log.time[log.episode == log.episodes[0]], str(self.log))
        motions = list(_motions(log, self.log, dt))
        if other is not None:
            known = [each[1:] for each in _motions(_dataset(other, posterior), other, dt)]
        else:
            first, rows = motions[0], round(min(seconds / dt, float(len(motions[0][0]))))
            known, motions[0] = [tuple(x[:rows] for x in first[1:])], tuple(x[rows:] for x in first)
        monitor = forcegp.ContactMonitor(posterior.predictor(), dt=dt, bandwidth=self.bandwidth)
        with terminal.progress("looking"):
            monitor.calibrate(known, false_alarms_per_hour=self.false_alarms)
            parts = [(time, q, monitor.run(q, v, u)) for time, q, v, u in motions if len(time) > 1]
        if not parts:
            raise InvalidInput(f"nothing is left of {self.log} after --free {self.free}.")
        contacts = [found for time, q, state in parts for found in _contacts(monitor, time, q, state)]
        content = {
            "run": str(self.model),
            "log": str(self.log),
            **{name: getattr(self, name) for name in ("free", "false_alarms", "bandwidth")},
            **{"dt": dt, "threshold": monitor.threshold, "seconds": sum(len(time) for time, *_ in parts) * dt},
        }
        title = f"{self.log.name}: {len(contacts)} contacts in {content['seconds']:.0f} s"
        with self.folder(self.out, content) as folder:
            write_json(folder / "contacts.json", {**content, "contacts": contacts})
            with (folder / "contacts.csv").open("w", encoding="utf-8", newline="") as file:
                table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                table.writeheader()
                table.writerows(contacts)
            time, _, state = max(parts, key=lambda part: len(part[0]))
            shown = [(each["start"], each["end"]) for each in contacts if time[0] <= each["start"] <= time[-1]]
            arrays = time, state.distance.numpy(), monitor.threshold, state.torque.numpy()
            figure = forcegp.scores.contacts_figure(*arrays, shown, log.joint_names, title)
            forcegp.scores.save_figure(figure, folder / "contacts.png")
        terminal.note(f"figure: {self.out / 'contacts.png'}")
        limit = monitor.threshold
        header = ["on", "from [s]", "to [s]", "force [N]", "distance /\nthreshold"]
        rows = [
            [each["link"], *(f"{each[name]:.2f}" for name in ("start", "end", "newton")), f"{each['peak'] / limit:.1f}"]
            for each in contacts
        ]
        terminal.show(columns(title, header, rows) if rows else title)
        return {**content, "contacts": contacts}


def _dataset(path: Path, posterior: Any) -> forcegp.Dataset:
    """The dataset, of the joints of the model. Raises InvalidInput for others."""
    dataset = forcegp.Dataset.load(path)
    require_same_joints(posterior, dataset, path)
    return dataset


def _motions(dataset: forcegp.Dataset, path: Path, dt: float) -> Iterator[tuple[Any, Any, Any, Any]]:
    """time, q, v and u of every episode. Raises InvalidInput for other time steps."""
    for number in dataset.episodes:
        at = dataset.episode == number
        step = forcegp.data.filters.uniform_step(dataset.time[at], f"episode {number} of {path}")
        if abs(step - dt) > 0.01 * dt:
            raise InvalidInput(
                f"{path} has steps of {step:.4g} s and the log of {dt:.4g} s; import both at one --rate."
            )
        yield dataset.time[at], dataset.q[at], dataset.v[at], dataset.u[at]


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
