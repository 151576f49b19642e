"""`forcegp view`: the robot along a recording in the browser, with the forces that a model learned."""

from __future__ import annotations

import tempfile
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.report
from forcegp.cli.command import THERE, URDF, Command, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Show a recording in 3D in the browser, with the forces of a model as arrows, or the recorded torques.

    The page is one file, which can be sent around. It plays the motion; a slider chooses the time.

    For example:
      forcegp view run test.h5 --shapes arm.urdf
      forcegp view log.h5 --out log.html
    """

    paths: Annotated[Positional[tuple[Path, ...]], THERE, arg(metavar="[RUN] LOG", help_behavior_hint="")]
    """A dataset (HDF5), and before it, if wished, the folder of a model."""
    shapes: Annotated[Path | None, URDF, unless_given("ROBOT.urdf", "capsules")] = None
    """What the links look like: a URDF with visual elements, its meshes beside it."""
    start: Annotated[float, arg(metavar="S")] = 0.0
    """Where in the recording to begin, in s."""
    seconds: Annotated[float, arg(metavar="S")] = 10.0
    """How much of it to show."""
    out: Annotated[Path | None, unless_given("FILE.html", "a temporary one, opened in the browser", Path)] = None
    """The page to write; it is not opened then."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Write, and open."""
        if len(self.paths) not in (1, 2):
            raise InvalidInput(f"{len(self.paths)} paths were given; give a dataset, or a model and a dataset.")
        *runs, log = self.paths
        self.require_free_file(self.out, forcegp.report.is_page, "a report")
        posterior = forcegp.load_posterior(runs[0]) if runs else None
        recorded = forcegp.report.recorded_scene(
            forcegp.Dataset.load(log), posterior, start=self.start, seconds=self.seconds, shapes=self.shapes
        )
        for doubt in recorded.doubts:
            terminal.warn(doubt)
        of = f", with the forces of {runs[0].name}" if runs else ""
        page = forcegp.report.Page(
            f"{log.name}, {recorded.time[-1]:.3g} s{of}",
            recorded.robot.name,
            scene=forcegp.report.recording(recorded),
            scene_notes=forcegp.report.scene_notes(recorded),
        )
        out = self.out or Path(tempfile.mkdtemp(prefix="forcegp-"), f"{log.stem}.html")
        forcegp.report.write_page(out, page, overwrite=self.overwrite)
        terminal.note(f"page: {out}")
        if self.out is None:
            webbrowser.open(out.resolve().as_uri())
        forces = [{"name": each.title, "unit": each.unit, "arrows": list(each.names)} for each in recorded.arrows]
        return {"rows": len(recorded.time), "seconds": float(recorded.time[-1]), "forces": forces, "html": str(out)}
