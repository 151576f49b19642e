"""What priors on forces are worth: `score` on recordings whose friction is known, and the page of its tables.

    python -m benchmarks.force_priors [--folder FOLDER] [CASE ...]

A recording has three episodes of 60 s: two to learn from, one to test. Finished pieces are kept in the folder, so the
same command goes on after an interruption.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from forcegp import Dataset, KukaSurfaceConfig, fit, score
from forcegp.atomic_files import write_text
from forcegp.forces import parse_forces
from forcegp.jobs import machine
from forcegp.scores import Scores
from forcegp.scores.accuracy import ACCELERATION, ALL_JOINTS, CONTACT_FORCE, TRUE_ACCELERATION
from forcegp.scores.page import formatted, markdown_table
from forcegp.simulation import simulate_kuka_surface
from forcegp.simulation.scenarios import Surface

PAGE = Path(__file__).resolve().parent.parent / "docs" / "benchmarks" / "force-priors.md"
EVERY, TEST_EPISODE = 4, 2
COLUMNS = (
    ("MAE", ACCELERATION, "mae", 4),
    ("noise-free", TRUE_ACCELERATION, "mae", 4),
    ("NLPD", ALL_JOINTS, "nlpd", 2),
    ("in 95 %", ACCELERATION, "coverage_95", 3),
    ("normal force", CONTACT_FORCE, "relative_rmse", 5),
    ("in 95 %", CONTACT_FORCE, "coverage_95", 3),
)
AT_TOOL = ("given", "gp:joint", "gp:tool-friction", "gp:contact-friction", "gp:load-friction")
WITH_JOINTS = ("given", "gp:joint", *(f"gp:joint-friction+{each}" for each in AT_TOOL[2:]))
STRIBECK: Mapping[str, Any] = {"joint_friction": "stribeck"}


@dataclass(frozen=True)
class Case:
    """A friction: its heading, the models, numbers of training points, and what the scenario has of it."""

    title: str
    models: Sequence[str]
    points: Sequence[int] = (200,)
    config: Mapping[str, Any] = field(default_factory=dict)


CASES = {
    "viscous": Case("Viscous friction at the tool, the paper's", AT_TOOL, (20, 100, 200)),
    "coulomb": Case("Coulomb friction at the tool, which grows with the load", AT_TOOL, config={"friction": "coulomb"}),
    "stribeck": Case("Stribeck friction at the tool", AT_TOOL, config={"friction": "stribeck"}),
    "joints": Case("Viscous at the tool, Stribeck in the joints", WITH_JOINTS, config=STRIBECK),
    "both": Case("Stribeck at the tool and in the joints", WITH_JOINTS, config=STRIBECK | {"friction": "stribeck"}),
}
INTRODUCTION = """# Force priors: results

`python -m benchmarks.force_priors` writes this page. `forcegp.score` compares the priors of [forces](../how-to/forces.md)
on simulated recordings of `kuka-surface`. Two episodes of 60 s are learned from, a third is the test.

`identified` is the rival: bodies, viscous and Coulomb friction of all training rows. Where the tool slides with an
unmeasured friction, nothing can be identified, so it is missing there. The noise of the acceleration is
.1 rad/s², so a perfect model has an MAE of about .079 on these rows. “Noise-free” is the error against the true acceleration, and errors
of the normal force are relative to its root mean square. Medians over seeds come with the least and the largest value.
A seed is a choice of training points; functions of one or two inputs learn from all rows.
"""  # noqa: E501  # one line of the page each


def recording(case: Case, seconds: float) -> Dataset:
    """The rows of a case: two episodes to learn from, and the test."""
    rows = simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=301, episodes=3, **case.config))
    return rows.rows(slice(None, None, EVERY))


def measured(case: Case, points: int, folder: Path, *, seconds: float = 60.0, **how: Any) -> Scores:
    """The scores of all models of a case."""
    how = {"split": f"episodes:{TEST_EPISODE}", "horizons": (), "points": points, **how}
    return score(case.models, recording(case, seconds), folder=folder, **how)


def table(scores: Scores) -> str:
    """One row for each model."""
    finished = [name for name in scores.models if scores.finished(name)]
    held = {name: scores.quantities(name) for name in finished}
    columns = [each for each in COLUMNS if any(each[2] in held[name].get(each[1], ()) for name in finished)]
    rows = [[f"`{name}`", *(
        formatted(scores.spread(key, quantity, name), digits) if key in held[name].get(quantity, ()) else "–"
        for _, quantity, key, digits in columns
    )] for name in finished]  # fmt: skip
    failures = [each for each in scores.failures if not each.startswith("identified")]  # as the introduction says
    return "\n\n".join([markdown_table(["model", *(title for title, *_ in columns)], rows), *failures])


def transfer(seconds: float = 60.0, points: int = 100, **how: Any) -> str:
    """Noise-free errors on the plane that a model learned on, and on surfaces that it never saw."""
    train = simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=301))
    surfaces: tuple[Surface, ...] = ("plane", "tilted")
    tests = {
        each: simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=302, surface=each)) for each in surfaces
    }
    rows = []
    for name in AT_TOOL[1:4]:
        assert train.model is not None, "a simulation has one"
        posterior = fit(train.model.with_forces(*parse_forces(name)), train, points=points, **how)
        errors = []
        for test in tests.values():
            some = test.rows(slice(None, None, EVERY))
            assert some.model is not None, "a simulation has one"
            found = score(posterior.with_contacts(some.model.contacts), some)
            errors.append(formatted(found.value("mae", TRUE_ACCELERATION)))
        rows.append([f"`{name}`", *errors])
    return markdown_table(["model", *tests], rows)


def main() -> None:
    """Measure the cases and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; all, and the page")
    parser.add_argument("--folder", type=Path, default=Path("force-priors"), help="where pieces are kept")
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args()
    parts = [INTRODUCTION]
    for name in given.cases or CASES:
        case = CASES[name]
        parts.append(f"## {case.title}\n")
        for points in case.points:
            place = given.folder / f"{name}-{points}"
            place.parent.mkdir(exist_ok=True, parents=True)
            part = f"{points} points:\n\n{table(measured(case, points, place, seeds=given.seeds))}\n"
            print(f"{case.title}, {part}", flush=True)
            parts.append(part)
    if not given.cases:
        told = (
            "`posterior.with_contacts(...)`: learned from 100 points on the plane, noise-free MAE on other surfaces.\n"
        )
        parts += ["## Other surfaces\n", told, f"{transfer()}\n"]
        write_text(PAGE, "\n".join([*parts, f"{machine()}, {given.seeds} seeds.\n"]))


if __name__ == "__main__":
    main()
