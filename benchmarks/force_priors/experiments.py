"""The experiments on force priors: data efficiency, friction as it is, other contacts."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Any

from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.force_priors.jobs import BLACK_BOX, KNOWN_PHYSICS, LAWS, MODEL, load
from benchmarks.force_priors.trials import (
    LABELS,
    ForceExperiment,
    Trial,
    dots_figure,
    heading,
    only_test,
    score_table,
    trial_name,
    trials_on,
)
from benchmarks.paper import published
from benchmarks.paper.figures import draw_range
from forcegp.jobs import JobStore
from forcegp.posterior import load_posterior
from forcegp.scores import friction_curves_figure, normal_force_figure
from forcegp.scores.figures.style import (
    MEASUREMENT,
    PREDICTION,
    QUIET,
    SERIES,
    legend_below,
    new_figure,
    plain_ticks,
    quiet,
)
from forcegp.scores.tables import formatted, markdown_table

EFFICIENT = {
    "joint forces on (q, v, u), the paper's": "gp:joint",
    "tool friction": "gp:tool-friction",
    "contact friction, isotropic": "gp:contact-friction",
}


@dataclass(frozen=True)
class DataEfficiency(ForceExperiment):
    """Every prior with the analytical mean at growing N; `region_points` of them for the extrapolation."""

    name, title = "data-efficiency", "Data efficiency"

    region_points: int = 50

    @override
    def trials(self) -> list[Trial]:
        curves = [Trial(label, "viscous", prior, n) for label, prior in EFFICIENT.items() for n in self.points]
        region = [Trial(label, "viscous", prior, self.region_points, region=True) for label, prior in EFFICIENT.items()]
        return [*curves, *region]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        figure = new_figure(8.6, 3.8)
        panels = figure.subplots(1, 2)
        scores = {"mae": "against noisy accelerations", "mae_noise_free": "against noise-free ones"}
        for axes, (score, title) in zip(panels, scores.items(), strict=True):
            for color, label in zip((MEASUREMENT, PREDICTION, SERIES[5]), EFFICIENT, strict=True):
                trials = [trial for trial in summary["trials"] if trial["label"] == label and not trial["region"]]
                draw_range(axes, {trial["points"]: only_test(trial)[score] for trial in trials}, color, label)
            axes.set(xscale="log", yscale="log")
            quiet(axes, title=f"MAE {title} [rad/s²]", x="training points N", y="")
        paper = published.FIG2B_MAE["s-gp-mean"]
        label = "S-GP + mean, published (2021)"
        panels[0].plot(list(paper), list(paper.values()), color=QUIET, linestyle="--", linewidth=1.0, label=label)
        perfect = published.NOISE_STD * (2.0 / pi) ** 0.5
        panels[0].axhline(perfect, color=QUIET, linewidth=0.8, label="noise floor")
        for axes in panels:
            plain_ticks(axes.xaxis)
            plain_ticks(axes.yaxis)
        legend_below(figure, panels[0], columns=2)
        return {"data-efficiency": figure}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        columns = ("mae", "mae_noise_free", "nlpd", "coverage_95", "normal_force_error", "normal_force_coverage")
        outside, inside = ([t for t in summary["trials"] if t["region"] == region] for region in (True, False))
        best = published.FIG2B_MAE["s-gp-mean"][1000]
        return "\n\n".join(
            [
                f"The paper's scenario, analytical mean, {len(self.seeds)} seeds. The paper's best model has an MAE of "
                f"{best} with 1000 points. A perfect one has the mean of the noise: 0.0798 in the long run, on these "
                f"test rows {formatted(only_test(inside[0]).get('mae_of_truth'))}.",
                score_table(inside, columns),
                "**Extrapolation**: trained on rows with the tool at x < 0, tested at x > 0.1 m.",
                score_table(outside, columns[:4]),
            ]
        )


JOINT_FORCES = "joint forces (the paper's)"
TOOL = {
    JOINT_FORCES: "gp:joint",
    "tool friction": "gp:tool-friction",
    "tool forces on velocity and place": "gp:tool-forces",
    "contact friction": "gp:contact-friction",
    "load friction": "gp:load-friction",
}
WITH_JOINTS = {
    JOINT_FORCES: "gp:joint",
    "joint + tool friction": "gp:joint-friction,gp:tool-friction",
    "joint + contact friction": "gp:joint-friction,gp:contact-friction",
    "joint + load friction": "gp:joint-friction,gp:load-friction",
}
PRIORS = dict.fromkeys(("viscous", "coulomb", "stribeck"), TOOL)
PRIORS |= dict.fromkeys(("viscous-joints", "stribeck-joints"), WITH_JOINTS)
PICTURED = ("stribeck-joints", "joint + load friction")


@dataclass(frozen=True)
class Friction(ForceExperiment):
    """Every prior that means something in a scenario, at one number of points."""

    name, title = "friction", "Friction as it is"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(label, scenario, prior, points)
            for scenario, priors in PRIORS.items()
            for label, prior in priors.items()
            for points in self.points
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        groups = {
            LABELS[scenario]: {trial["label"]: only_test(trial) for trial in trials_on(scenario, summary)}
            for scenario in ("stribeck", "stribeck-joints")
        }
        (pictured,) = [t for t in self.trials()[:: len(self.points)] if (t.scenario, t.label) == PICTURED]
        seed = self.seeds[0]
        posterior = load_posterior(results.place(trial_name(pictured, seed)) / MODEL)
        test = load(results, self.data_job(pictured.scenario, seed, training=False).name)
        return {
            "friction-errors": dots_figure(groups, "mae_noise_free", "mean absolute error, noise-free [rad/s²]"),
            "friction-curves": friction_curves_figure(posterior, test),
            "friction-normal-force": normal_force_figure(posterior, test),
        }

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        columns = ("mae", "mae_noise_free", "normal_force_error", "normal_force_coverage", "component_sum_error")
        parts = [
            f"{', '.join(map(str, self.points))} points, analytical mean, {len(self.seeds)} seeds. The normal force is "
            "that of the simulation; its error is relative to its own root mean square. “Sum of components” is the "
            "largest difference between the sum of all component forces and the total. “Curve in its band” is "
            "the share of the visited velocities at which the 95 % band of a friction curve holds the law that was "
            "simulated, mean over the model's curves, where its prior has such a law. The pictures show the last model "
            "of the last table."
        ]
        for scenario in PRIORS:
            trials = trials_on(scenario, summary)
            parts += [heading(LABELS[scenario]), score_table(trials, columns)]
            curves = [
                f"{trial['label']} {formatted(trial['curve_coverage_of_seeds'], 3)}"
                for trial in trials
                if trial["curve_coverage_of_seeds"] is not None
            ]
            if curves:
                parts.append(f"Curve in its band: {'; '.join(curves)}.")
        return "\n\n".join(parts)


OTHER_LAWS = tuple(f"{law}-joints" for law in ("exponential", "asymmetric", "load", "lugre", "drift"))
RIVALS = {
    "known physics alone": KNOWN_PHYSICS,
    "Coulomb's and viscous friction of every joint": LAWS,
    "independent GP": BLACK_BOX,
    "GP on what known physics leaves": "gp:joint-accelerations",
    JOINT_FORCES: "gp:joint",
    "joint friction": "gp:joint-friction",
}


@dataclass(frozen=True)
class OtherLaws(ForceExperiment):
    """Friction of the joints by laws that the kernel of `JointFriction` does not contain, and parametric rivals."""

    name, title = "other-laws", "Laws that are not the kernel's"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(label, law, prior, n) for law in OTHER_LAWS for label, prior in RIVALS.items() for n in self.points
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            f"Free motion, analytical mean, {', '.join(map(str, self.points))} points, {len(self.seeds)} seeds. The "
            "Stribeck friction of the tables above is of the form of the kernel, tanh(v / w) times a curve plus d v; "
            "these laws are not, but for the first. The rival with Coulomb's and viscous friction is fitted by maximum "
            "likelihood and knows how smooth the sign is. Bristles have a memory: within 0.01 rad after a reversal "
            "their force is not a function of the velocity, and every model of friction over the velocity fails there."
        ]
        columns = ("mae", "mae_noise_free", "nlpd", "coverage_95", "coverage_95_noise_free")
        for law in OTHER_LAWS:
            parts += [heading(LABELS[law]), score_table(trials_on(law, summary), columns)]
        return "\n\n".join(parts)


SURFACES = {"plane": "viscous", "tilted plane": "tilted", "sphere": "sphere"}
SURFACES_AND_JOINTS = {
    "plane": "viscous-joints",
    "tilted plane": "tilted-joints",
    "sphere": "sphere-joints",
    "free motion": "free-joints",
}


@dataclass(frozen=True)
class Transfer(ForceExperiment):
    """Trained on the plane, tested on every other surface."""

    name, title = "transfer", "Transfer to other contacts"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(label, scenario, priors[label], points, tests)
            for points in self.points
            for scenario, priors, tests, labels in (
                ("viscous", TOOL, SURFACES, ("tool friction", "contact friction", JOINT_FORCES)),
                ("viscous-joints", WITH_JOINTS, SURFACES_AND_JOINTS, ("joint + tool friction", JOINT_FORCES)),
            )
            for label in labels
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            f"`posterior.with_contacts(...)`: trained on the plane, analytical mean, {len(self.seeds)} seeds; MAE "
            "against noise-free accelerations [rad/s²], and in brackets how many times as large as on the plane "
            "(ratio of medians)."
        ]
        for scenario, tests, title in (
            ("viscous", SURFACES, "Viscous friction at the tool"),
            ("viscous-joints", SURFACES_AND_JOINTS, "Viscous friction at the tool, Stribeck friction in the joints"),
        ):
            rows = []
            for trial in trials_on(scenario, summary):
                home = trial["tests"]["plane"]["mae_noise_free"]
                errors = [trial["tests"][label]["mae_noise_free"] for label in tests]
                cells = [f"{formatted(error)} [{error['median'] / home['median']:.2f}]" for error in errors]
                rows.append([trial["label"], str(trial["points"]), *cells])
            parts += [f"**{title}**", markdown_table(["model", "points", *tests], rows)]
        return "\n\n".join(parts)
