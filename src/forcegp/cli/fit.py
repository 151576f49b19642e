"""`forcegp fit`: learn the unknown forces from a dataset and write the model to a folder."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import forcegp
import forcegp.evaluation
import forcegp.inference
import forcegp.models
import forcegp.priors
import forcegp.robots
from forcegp.cli.model_choice import (
    POINTS,
    ModelOptions,
    make_model,
    resolved,
    resolved_noise,
    search_arguments,
    window_observation,
)
from forcegp.cli.terminal import Terminal, columns, facts, with_option_names
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Fit(ModelOptions):
    """Learn the unknown forces from a dataset, and write the model to a folder.

    The dataset carries its robot and contacts, so nothing else is needed; --robot, --contact and --known-force
    override it.

    For example:
      forcegp fit train.h5 --points 100 --out run
      forcegp fit train.h5 --prior tool-friction,joint-friction --points 100 --out run
      forcegp fit train.h5 --model independent-gp --points 100 --out baseline
      forcegp fit log.h5 --robot arm.urdf --contact tool@0,0,0.1:plane:0,0,1,0.055 --noise learned --out run
      forcegp fit raw.h5 --learn-from weak-form --window 0.1 --points 100 --out run
      forcegp fit log.h5 --identified identified --prior joint-friction --points 400 --motions 1 --out run
    """

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Fit and save."""
        self.require_free(self.out)
        if self.motions is not None and not 0.0 < self.motions < math.inf:
            raise InvalidInput(f"--motions is {self.motions:g}; give the length of the windows in seconds, such as 1.")
        command = resolved(self)
        self._backend()  # refused now, not after the data are read
        forcegp.robots.usable_device(self.device)
        start = time.monotonic()
        dataset = forcegp.Dataset.load(self.data)
        system = self._system(dataset)
        self._check(terminal, dataset, system, self.learn_from == "accelerations")
        recording, rows_note = dataset, None
        if self.rows != "auto" or self.learn_from == "accelerations":  # raw accelerations show no contact
            dataset, rows_note = self._rows(dataset, system)
        observe = window_observation(command.learn_from, command.window)
        prior_note, correlation_note, intervals_note = None, None, None
        if command.model == "structured" and not command.prior:
            command, prior_note = self._with_prior(command, dataset, system)
        model = make_model(command, system.to(self.device))
        # of functions of few inputs, inducing points stand for any number of rows
        few = isinstance(model, forcegp.StructuredGP) and forcegp.priors.has_few_inputs(model.prior, system.robot)
        all_rows = few and observe is None and command.points is None and command.engine in ("auto", "inducing")
        rows = len(dataset) if observe is None else observe.count(dataset)
        points = rows if all_rows else min(POINTS if command.points is None else command.points, rows)
        command = replace(command, points=points)
        how = search_arguments(command, points)
        if all_rows:
            assert isinstance(model, forcegp.StructuredGP)
            model = forcegp.evaluation.with_force_noise(model, dataset)
            given = {} if command.learning_points is None else {"learning_points": command.learning_points}
            how |= forcegp.evaluation.all_rows_at_once(points, system.robot.nv) | given
        posterior = fit_with_progress(terminal, model, dataset, points=points, **how)
        if all_rows:
            found = forcegp.evaluation.allowing_for_correlation(posterior, dataset, command.hyperprior)
            posterior, correlation_note = found
        if self.motions is not None:
            posterior = refined_with_progress(terminal, posterior, recording, self.motions)
            posterior, intervals_note = calibrated_with_progress(terminal, posterior, recording)
        summary = fit_summary(posterior, time.monotonic() - start) | {"payloads": payloads(posterior, dataset)}
        command._write(posterior)
        for note in (rows_note, prior_note, correlation_note, intervals_note):
            if note is not None:
                terminal.note(note)
        for doubt in forcegp.evaluation.unfinished_search(posterior):
            terminal.warn(doubt)
        terminal.show(*_report(self.out, summary), *motion_report(posterior))
        return {"run": str(self.out), "data": str(self.data), **summary, "settings": dict(posterior.settings)}

    def _with_prior(self, command: Fit, dataset: forcegp.Dataset, system: forcegp.MechanicalSystem) -> tuple[Fit, str]:
        """The command with the prior that a look at some rows prefers, and the reason."""
        if command.mean == "zero":
            return replace(command, prior=("joint",)), "prior: joint, since the processes hold the known forces, too"
        if command.learn_from != "accelerations":
            name = forcegp.evaluation.usual_prior(system)
            return replace(command, prior=(name,)), f"prior: {name}, the usual one; windows are not looked at"
        noise = resolved_noise(command.noise, command.force_noise)
        options = replace(forcegp.models.default_options(forcegp.evaluation.LOOK), iterations=command.iterations)
        name, why = forcegp.evaluation.choose_prior(dataset, system, noise=noise, seed=command.seed, options=options)
        return replace(command, prior=(name,)), f"prior: {why}"


def fit_with_progress(
    terminal: Terminal, model: Any, dataset: forcegp.Dataset, *, name: str = "fitting", **how: Any
) -> Any:
    """`fit`, `fit_windows` or `identify` of a model, as `how` asks, with a bar of restart, iteration and objective."""
    steps = how["options"].iterations
    wanted = how.get("restarts", 1)
    restarts = forcegp.models.default_restarts(how["points"]) if wanted is None else wanted
    with terminal.progress(f"{name}: {how['points']} points", may_end_early=True) as report:

        def progress(restart: int, iteration: int, value: float) -> None:
            if restart == forcegp.models.ALL_ROWS:
                report(restarts * steps, restarts * steps, f"all {how['points']} points: {iteration}, {value:.3g}")
                return
            start = f"start {restart + 1} of {restarts}, " if restarts > 1 else ""
            note = f"{start}iteration {iteration}, objective {_short(value)}"
            report(restart * steps + min(iteration, steps), restarts * steps, note)

        learn = model.identify if "learn" in how else model.fit_windows if "observe" in how else model.fit
        return learn(dataset, **how, progress=progress)


def refined_with_progress(
    terminal: Terminal, posterior: Any, dataset: forcegp.Dataset, seconds: float, **how: Any
) -> Any:
    """`refined_on_motions`, with a bar of steps and the error of the motions."""
    steps = 100
    with terminal.progress(f"motions of {seconds:g} s", may_end_early=True) as report:
        return posterior.refined_on_motions(
            dataset,
            seconds,
            **how,
            report=lambda step, rms: report(min(step, steps), steps, f"step {step}, rms of q {rms:.3g}"),
        )


def calibrated_with_progress(terminal: Terminal, posterior: Any, dataset: forcegp.Dataset) -> tuple[Any, str | None]:
    """`calibrated_on_motions` with a bar; the posterior itself, and why, where the recording is too short for it."""
    with terminal.progress("intervals of motions") as report:
        try:
            return posterior.calibrated_on_motions(dataset, report=report), None
        except InvalidInput as error:
            return posterior, f"intervals of motions are not calibrated: {error}"


def motion_report(posterior: Any) -> list[Any]:
    """What motions refined, as a table and a sentence; nothing where they did not."""
    found = posterior.settings.get("motions")
    if found is None:
        return []
    errors = found["standard_errors"]
    rows = [[name, f"{value:.4g}", f"{errors[name]:.2g}"] for name, value in found["parameters"].items()]
    units = ["mm" if joint.type == "prismatic" else "mrad" for joint in posterior.system.robot.joints]
    error = ", ".join(f"{1e3 * rms:.3g} {unit}" for rms, unit in zip(found["rms"], units, strict=True))
    summary = (
        f"{found['windows']} windows of {found['seconds']:g} s, whose initial states are estimated, too; rms of q by "
        f"joint: {error}."
    )
    weak = f"Not identified by the motions: {', '.join(found['not_told'])}." if found["not_told"] else ""
    table = columns("refined on motions", ["", "value", "std. error"], rows)
    return [*([table] if rows else []), summary, *([weak] if weak else [])]


def fit_summary(posterior: forcegp.models.Posterior, wall_seconds: float) -> dict[str, Any]:
    """What a fit came to, as plain values. `objective` is what the search lowered, `nll` the likelihood alone."""
    result, settings = posterior.result, posterior.settings
    force_noise, prior = posterior.parameters.get("noise.log_force"), getattr(posterior.model, "prior", None)
    air = [x for x in prior.summands() if isinstance(x, forcegp.AerodynamicForce)] if prior else []
    looked = not {"air", "observe"} & set(settings) and not posterior.system.held_inputs  # not for wind in windows
    return {
        "model": posterior.description,
        "objective_is": posterior.objective,
        "points": len(posterior.training),
        "learning_points": settings.get("learning_points", len(posterior.training)),
        "objective_start": result.history[0],
        "objective": result.value,
        "nll": posterior.negative_log_likelihood,
        **({"engine": settings["engine_reason"]} if "engine_reason" in settings else {}),
        **({"refined": settings["refined"]} if "refined" in settings else {}),
        "restarts": posterior.settings.get("restarts", 1),
        "iterations": len(result.history) - 1,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "status": result.status,
        "noise_std": posterior.noise_std.tolist(),
        "wind": posterior.settings.get("air", {}).get("wind"),
        "wind_not_found": looked and any(x.observe != 0.0 for x in air),
        "steady_forces": posterior.settings.get("steady_forces"),
        "force_noise_std": None if force_noise is None else force_noise.exp().tolist(),
        "cpu_seconds": result.cpu_seconds,
        "wall_seconds": wall_seconds,
    }


def payloads(posterior: Any, dataset: forcegp.Dataset) -> dict[str, str]:
    """Mass and centre of mass of every `payload` prior, with standard deviations, by the name of its term."""
    if not isinstance(posterior, forcegp.models.StructuredPosterior) or "Payload" not in repr(posterior.model.prior):
        return {}
    found = {}
    for name, part in posterior.components(dataset.q[:1], dataset.v[:1], dataset.u[:1]).items():
        if "mass" not in part.latent_names:
            continue
        assert part.latents.covariance is not None
        mean, covariance = part.latents.mean[0], part.latents.covariance[0]
        found[name] = f"{mean[0]:.3g} ± {covariance[0, 0].sqrt():.2g} kg"
        if len(mean) == 4:
            center = mean[1:] / mean[0]
            slopes = mean.new_zeros(3, 4)  # of the centre in mass and moments (delta method)
            slopes[:, 0], slopes[:, 1:] = -center / mean[0], mean.new_ones(3).diag() / mean[0]
            errors = (slopes @ covariance @ slopes.mT).diagonal().sqrt()
            each = (f"{1e3 * x:.3g} ± {1e3 * error:.2g}" for x, error in zip(center, errors, strict=True))
            found[name] += f" at ({', '.join(each)}) mm"
    return found


def _report(run: Path, summary: Mapping[str, Any]) -> list[Any]:
    forces, air = summary.get("force_noise_std"), summary.get("wind")
    still = "learned as still air" + (", with a force in each episode" if summary.get("steady_forces") else "")
    points, learning = summary["points"], summary["learning_points"]
    refined = " and refined on all" if "refined" in summary else ""
    fewer = f" (parameters: from {learning} of them{refined})" if learning != points else ""
    # the status counts failed evaluations, too, and the starts
    status = with_option_names(summary["status"], ("iterations",))
    unit = summary["objective_is"].partition(" [")[2].removesuffix("]")
    table = facts(
        f"{run}: {summary['model']}, learned from {points} points{fewer}",
        {
            **summary.get("payloads", {}),
            **({"engine": summary["engine"]} if "engine" in summary else {}),
            "objective": f"{_short(summary['objective_start'])} → {_short(summary['objective'])} {unit}",
            "negative log likelihood": f"{summary['nll']:.1f} nats",
            "iterations": f"{summary['iterations']} ({summary['evaluations']} evaluations)",
            "search": status if summary["converged"] else f"not converged: {status}",
            "noise std": _per_joint(summary["noise_std"]),
            **({} if forces is None else {"noise std of forces": _per_joint(forces)}),
            **({} if air is None else {"wind of these rows": f"{air[0]:.1f} m/s along x, {air[1]:.1f} m/s along y"}),
            **({"wind of these rows": f"not found; {still}"} if summary.get("wind_not_found") else {}),
            "time": f"{summary['cpu_seconds']:.1f} s CPU for the search, {summary['wall_seconds']:.1f} s in all",
        },
    )
    return [table, f"Next: forcegp evaluate {run} TEST.h5"]


def _per_joint(values: list[float]) -> str:
    return f"{values[0]:.4g}" if len(set(values)) == 1 else " ".join(f"{value:.3g}" for value in values)


def _short(value: float) -> str:
    """One decimal for nats of a likelihood, three digits for small losses."""
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3g}"
