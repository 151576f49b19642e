"""`forcegp compare`: which prior on the unknown forces the data support."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

import forcegp
import forcegp.evaluation
import forcegp.models
import forcegp.priors
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, FIELDS, listed, unless_given
from forcegp.cli.input_options import ROBOT_OPTIONS
from forcegp.cli.learning_options import LearningOptions
from forcegp.cli.model_choice import POINTS, PRIORS, resolved_noise
from forcegp.cli.terminal import NONE, Terminal, columns, number
from forcegp.errors import InvalidInput

SAME = (*ROBOT_OPTIONS, "contact", "known_force", "mean", "noise", "force_noise", "rows", "hyperprior")
"""Options that a fit needs, too: for another robot, contact or noise nothing was compared."""


@dataclass(frozen=True, kw_only=True)
class Compare(LearningOptions):
    """Fit several priors on the unknown forces to the same rows, and report which of them the data support.

    Each entry of --priors is one candidate, and may be a sum. Candidates are scored by the log density of stretches of
    time that are left out of the training rows, without another fit. With --test also on another recording.

    For example:
      forcegp compare train.h5 --priors joint,tool-friction --points 100
      forcegp compare train.h5 --priors "tool-friction,tool-friction + joint-friction" --test test.h5
    """

    priors: Annotated[tuple[str, ...], listed(PRIORS, goes_on=FIELDS)] = ()
    """Two candidates or more: names of priors as in forcegp fit, or sums such as "tool-friction + joint-friction"."""
    out: Annotated[Path | None, unless_given("FOLDER", "nothing is written")] = None
    """Also write every fitted model and comparison.json into this folder."""
    points: Annotated[int | None, unless_given("N", f"{POINTS}, or all rows", int)] = None
    """Train on N rows that lie farthest apart. Time grows with the cube of N."""
    mean: Literal["analytical", "zero"] = "analytical"
    """analytical: the processes learn what the known forces lack. zero: they learn the known forces, too."""
    iterations: Annotated[int, arg(metavar="N")] = 200
    """Most L-BFGS iterations of each start."""
    block_seconds: Annotated[float | None, unless_given("S", "a twentieth of the recording", float)] = None
    """Length of the stretches of time that are left out; longer than the time over which motion is correlated."""
    test: Annotated[Path | None, DATASET, unless_given("TEST.h5", "none")] = None
    """Another recording to score the candidates on as well."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Fit, compare, write if asked to, and show."""
        if len(self.priors) < 2:
            given = f"only {self.priors[0]}" if self.priors else "none"
            raise InvalidInput(f"--priors lists the candidates, and there is {given}; give two or more, as in a,b.")
        self.require_free(self.out)

        dataset = forcegp.Dataset.load(self.data)
        system = self._system(dataset)
        priors = self._priors(system)
        self._check(terminal, dataset, system)
        dataset, rows_note = self._rows(dataset, system)
        test = None if self.test is None else forcegp.Dataset.load(self.test)
        comparison = self._compare(terminal, dataset, system, priors, test)
        for warning in comparison.warnings:
            terminal.warn(warning)
        content = {"data": str(self.data), "test": None if self.test is None else str(self.test)}
        content |= comparison.to_dict()
        # letters that every file system takes, with a number where two names become one
        plain = {name: re.sub(r"[^\w.+-]+", "_", name.replace(" ", "")) for name in comparison.posteriors}
        all_of = list(plain.values())
        folders = {
            name: text if all_of.count(text) == 1 else f"{text}-{k}" for k, (name, text) in enumerate(plain.items())
        }
        if self.out is not None:
            with self.folder(self.out, self._given()) as folder:
                for name, posterior in comparison.posteriors.items():
                    forcegp.save_posterior(posterior, folder / folders[name])
                write_json(folder / "comparison.json", {**content, "models": folders})
        if rows_note is not None:
            terminal.note(rows_note)
        terminal.show(*self._report(comparison, folders))
        return content

    def _priors(self, system: forcegp.MechanicalSystem) -> dict[str, forcegp.priors.ForcePrior]:
        priors: dict[str, forcegp.priors.ForcePrior] = {}
        for expression in self.priors:
            prior = forcegp.priors.named_prior(expression, system)
            same = next((name for name, other in priors.items() if other == prior), None)
            if same is not None:
                raise InvalidInput(f"--priors: {expression!r} is the same as {same!r}; give each candidate once.")
            priors[re.sub(r"\s*\+\s*", " + ", expression.strip())] = prior
        return priors

    def _compare(
        self,
        terminal: Terminal,
        dataset: forcegp.Dataset,
        system: forcegp.MechanicalSystem,
        priors: Mapping[str, forcegp.priors.ForcePrior],
        test: forcegp.Dataset | None,
    ) -> forcegp.PriorComparison:
        points = min(POINTS, len(dataset)) if self.points is None else self.points
        options = forcegp.models.default_options(points)
        options = replace(options, iterations=self.iterations)
        restarts = forcegp.models.default_restarts(points) if self.restarts is None else self.restarts
        names, steps = list(priors), options.iterations
        with terminal.progress(f"comparing: {points} points", may_end_early=True) as report:

            def progress(name: str, restart: int, iteration: int, value: float) -> None:
                done = (names.index(name) * restarts + restart) * steps + min(iteration, steps)
                report(done, len(names) * restarts * steps, f"{name}, iteration {iteration}, objective {value:.1f}")

            return forcegp.compare_priors(
                dataset,
                priors,
                points=points,
                system=system,
                noise=resolved_noise(self.noise, self.force_noise),
                restarts=restarts,
                backend=self._backend(),
                options=options,
                test=test,
                progress=progress,
                **{name: getattr(self, name) for name in ("mean", "seed", "hyperprior", "block_seconds")},
            )

    def _report(self, comparison: forcegp.PriorComparison, folders: Mapping[str, str]) -> list[Any]:
        header = ["prior", "latents,\nparam.", "NLL", "row\nout", "stretch\nout", "below\nthe best"]
        header += [] if self.test is None else ["MAE,\ntest"]
        title = (
            f"{comparison.points} points of {self.data}, {comparison.blocks} stretches of "
            f"{comparison.block_seconds:.3g} s; log densities of what is left out in nats per row, ± standard error"
        )
        rows = [self._row(score, comparison) for score in comparison.scores]
        preferred = comparison.preferred.name
        if self.out is not None:
            following = f"Next: forcegp evaluate {self.out / folders[preferred]} TEST.h5"
        else:
            words = [str(self.data), *self.words(*SAME), "--prior", preferred, "--points", str(comparison.points)]
            following = f"Next: forcegp fit {shlex.join(words)} --out run"
        table = columns(title, header, rows, long_names=True)
        return [table, comparison.verdict, following]

    def _row(self, score: forcegp.evaluation.PriorScore, comparison: forcegp.PriorComparison) -> list[str]:
        best = score is comparison.best
        return [
            score.name,
            f"{score.latents}, {score.parameters}",
            f"{score.nll:.0f}",
            _density(score.leave_one_out),
            _density(score.leave_block_out),
            NONE if best else f"{_density(-score.difference)} ± {_density(score.standard_error)}",
            *([] if self.test is None else [number(score.mae)]),
        ]


def _density(value: float) -> str:
    """Three decimals, none for numbers of 100 and more: the table has to fit into 80 columns."""
    return f"{value:.3f}" if abs(value) < 100.0 else f"{value:.0f}"
