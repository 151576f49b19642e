"""`forcegp rollout`: let a fitted model predict whole motions, and compare them with the recorded ones."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.evaluation
import forcegp.posterior
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, MODEL, Overwriting, listed, numbers_of, unless_given
from forcegp.cli.input_options import SystemChoice, model_and_data
from forcegp.cli.terminal import Terminal, columns, facts, number, percent, shown
from forcegp.errors import InvalidInput

DEFAULT_STARTS = 10
MOMENTS = (0.1, 0.25, 0.5, 1.0)
"""Parts of the duration at which the table shows the errors."""
LOW_COVERAGE = 0.8
ENOUGH_SAMPLES = 20  # fewer span less by chance


@dataclass(frozen=True, kw_only=True)
class Rollout(Overwriting):
    """Predict whole motions under recorded torques with a fitted model, and compare them with the recording.

    The motions begin at rows of the dataset.

    For example:
      forcegp rollout run test.h5 --starts 10 --seconds 1 --baumgarte 10,1 --out rollout
      forcegp rollout run test.h5 --start-rows 0,240 --integrator projected --samples 20 --out rollout
    """

    run_folder: Annotated[Positional[Path], MODEL, arg(metavar="RUN")]
    """The folder that `forcegp fit --out` wrote."""
    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """A recording with equal time steps that the model has not seen (HDF5)."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write: rollout.json, rollout.h5 and rollout.png."""
    start_rows: Annotated[tuple[int, ...], listed("ROW,...", "--starts", of=int)] = ()
    """Begin at these rows of the dataset."""
    starts: Annotated[int | None, unless_given("N", "10")] = None
    """Begin at N rows, spread evenly over the recording."""
    seconds: Annotated[float, arg(metavar="S")] = 1.0
    """How long each motion lasts."""
    system: SystemChoice = "model"
    """Robot and contacts to roll out: model, those that it was trained with; data, those of the recording."""
    integrator: Annotated[str, arg(metavar="NAME")] = "symplectic-euler"
    """symplectic-euler (as in PyBullet), rk4, implicit-midpoint (stiff friction), projected (contacts hold exactly)."""
    baumgarte: Annotated[str, arg(metavar="OMEGA[,ZETA]|none")] = "none"
    """Stabilisation of the contacts in the rollout, rad/s and damping ratio (1 if left out)."""
    samples: Annotated[int, arg(metavar="N")] = 0
    """Also roll out N functions drawn from the model, for intervals. Time grows with N."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the functions."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Roll out, compare, draw and show."""
        if self.start_rows and self.starts is not None:
            raise InvalidInput("--start-rows and --starts were both given; give the rows or their number.")
        rows = list(self.start_rows) or (DEFAULT_STARTS if self.starts is None else self.starts)
        baumgarte = parse_baumgarte(self.baumgarte)
        self.require_free(self.out)

        posterior, dataset = model_and_data(terminal, self.run_folder, self.data, self.system)
        for sentence in forcegp.evaluation.system_warnings(posterior, dataset):
            terminal.warn(sentence)
        recorded = forcegp.data.recorded_motions(dataset, rows, self.seconds)
        begun = time.process_time()
        with terminal.progress(f"rolling out: {len(recorded.rows)} motions of {recorded.time[-1]:.3g} s") as report:
            how = {name: getattr(self, name) for name in ("integrator", "samples", "seed")}
            begin = recorded.q[:, 0], recorded.v[:, 0]
            rollout = posterior.rollout(*begin, recorded.u, recorded.dt, **how, baumgarte=baumgarte, progress=report)
        cpu_seconds = time.process_time() - begun
        errors = forcegp.evaluation.rollout_errors(rollout, recorded, posterior.model)
        summary = self._summary(rollout, recorded, errors, dataset, cpu_seconds)
        options = ("run", "data", "rows", "seconds", "system", "integrator", "baumgarte", "samples", "seed")
        content = {"options": {name: summary[name] for name in options}}
        with self.folder(self.out, content) as folder:
            write_json(folder / "rollout.json", summary)
            _write_arrays(folder / "rollout.h5", rollout, recorded, dataset.joint_names)
            stabilised = "" if self.baumgarte == "none" else f", Baumgarte {self.baumgarte}"
            title = f"{errors.time[-1]:.3g} s under recorded torques, {self.integrator}{stabilised}"
            figure = forcegp.evaluation.rollout_figure(rollout, recorded, errors, dataset, title)
            forcegp.evaluation.save_figure(figure, folder / "rollout.png")
        held = summary["moments"][-1]["inside_95"]
        if self.samples >= ENOUGH_SAMPLES and held is not None and held < LOW_COVERAGE:
            terminal.warn(
                f"the 95 % intervals hold {held:.0%} of the recorded motion: functions that --samples draws leave out "
                "noise, gusts and errors of the start. `forcegp fit --motions` finds intervals on motions left out."
            )
        terminal.note(f"figure: {self.out / 'rollout.png'}")
        terminal.show(*_report(summary))
        return summary

    def _summary(
        self,
        rollout: forcegp.posterior.Rollout,
        recorded: forcegp.data.RecordedMotions,
        errors: forcegp.evaluation.RolloutErrors,
        dataset: forcegp.Dataset,
        cpu_seconds: float,
    ) -> dict[str, Any]:
        steps, baumgarte = len(errors.time) - 1, rollout.baumgarte
        at = sorted({max(1, round(part * steps)) for part in MOMENTS})
        return {
            "run": str(self.run_folder),
            "data": str(self.data),
            "rows": list(recorded.rows),
            "dt": recorded.dt,
            "seconds": float(errors.time[-1]),
            "steps": steps,
            "unit": dataset.units["q"] if isinstance(dataset.units["q"], str) else "rad or m",
            **{name: getattr(self, name) for name in ("system", "integrator", "samples", "seed")},
            "baumgarte": None if baumgarte is None else {"omega": baumgarte.omega, "zeta": baumgarte.zeta},
            "diverged_at": errors.diverged_at.tolist(),
            "initial_correction": rollout.initial_correction.amax(0).tolist(),
            "cpu_seconds": cpu_seconds,
            "constraint_max": _number(errors.constraint, "max"),
            "constraint_median": _number(errors.constraint, "median"),
            "moments": [_moment(errors, row) for row in at],
        }


def _write_arrays(path: Path, rollout: Any, recorded: forcegp.data.RecordedMotions, joint_names: Sequence[str]) -> None:
    from forcegp.data.hdf5 import new_file  # here, so that --help does not wait for it

    arrays = {name: getattr(rollout, name) for name in ("time", "q", "v", "a", "constraint", "diverged_at")}
    if rollout.samples is not None:
        arrays |= {f"samples/{name}": getattr(rollout.samples, name) for name in ("q", "v", "a", "constraint")}
    with new_file(path) as file:
        for name, values in arrays.items():
            file[name] = values.cpu().numpy()
        for name in ("q", "v", "u"):
            file[f"recorded/{name}"] = getattr(recorded, name)
        file["recorded/row"] = list(recorded.rows)
        file.attrs["joint_names"] = list(joint_names)


def parse_baumgarte(given: str) -> forcegp.Baumgarte | None:
    """`none`, `OMEGA` or `OMEGA,ZETA`. Raises InvalidInput for anything else."""
    if given == "none":
        return None
    complaint = f"--baumgarte is {given!r}; give none, OMEGA or OMEGA,ZETA, for example 10,1."
    numbers = numbers_of(given, complaint)
    if len(numbers) > 2:
        raise InvalidInput(complaint)
    return forcegp.Baumgarte(*numbers)


def _moment(errors: forcegp.evaluation.RolloutErrors, row: int) -> dict[str, Any]:
    """Errors at one moment; the joint error is that of the worst joint. What diverged is the farthest of a median."""
    worst = errors.joint[:, row].max(-1)
    return {
        "time": float(errors.time[row]),
        "lasting": int((worst == worst).sum()),  # NaN is not equal to itself
        "joint_error_median": _number(worst, "median"),
        "joint_error_max": _number(worst, "max"),
        "tool_error_median": _number(None if errors.tool is None else errors.tool[:, row], "median"),
        "constraint_max": _number(None if errors.constraint is None else errors.constraint[:, : row + 1], "max"),
        "inside_95": _number(None if errors.inside is None else errors.inside[:, 1 : row + 1], "mean"),
    }


def _number(values: Any, statistic: str) -> float | None:
    """A statistic of the finite values of an array, a median of all; None if there is none."""
    import numpy as np  # here, so that --help does not wait for it

    if values is None:
        return None
    finite = np.isfinite(values)
    counted = np.where(finite, values, np.inf) if statistic == "median" else values[finite]
    found = float(getattr(np, statistic)(counted)) if counted.size else np.inf
    return found if np.isfinite(found) else None


def _report(summary: Mapping[str, Any]) -> list[Any]:
    of_contacts = {"tool_error_median": "tool error,\nmedian", "constraint_max": "largest |c|\nso far"}
    of_contacts = {
        name: title for name, title in of_contacts.items() if any(each[name] is not None for each in summary["moments"])
    }
    intervals = any(moment["inside_95"] is not None for moment in summary["moments"])
    header = ["after", "motions", "joint error,\nmedian", "\nlargest"]
    header += of_contacts.values()
    header += ["in 95 %\ninterval"] if intervals else []
    rows = []
    for moment in summary["moments"]:
        cells = [f"{moment['time']:.3g} s", str(moment["lasting"])]
        cells += [number(moment["joint_error_median"]), number(moment["joint_error_max"])]
        cells += [shown(moment[name], "{:.3g} mm", 1e3) for name in of_contacts]
        rows.append([*cells, percent(moment["inside_95"])] if intervals else cells)
    count = len(summary["rows"])
    title = f"{count} motions against {summary['data']}; joint error: the worst joint, {summary['unit']}"
    ended = sum(row >= 0 for row in summary["diverged_at"])
    values = {"integrator": summary["integrator"], "diverged": f"{ended} of {count}"}
    if summary["integrator"] == "projected" and of_contacts:
        moved = summary["initial_correction"]
        values["initial states"] = f"moved onto the contacts by up to {moved[0]:.1e} rad and {moved[1]:.1e} rad/s"
    values["time"] = f"{summary['cpu_seconds']:.1f} s CPU"
    return [columns(title, header, rows), facts("", values)]
