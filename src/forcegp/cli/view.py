"""`forcegp view`: the robot along a recording in the browser, with the forces that a model learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.report
from forcegp.cli.command import URDF, InputPath, Overwriting, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

EXISTING = InputPath(" does not exist; give a folder of forcegp fit, or a dataset (.h5).", Path.exists)


@dataclass(frozen=True, kw_only=True)
class View(Overwriting):
    """Show a recording in 3D in the browser, with the forces of a model as arrows, or the recorded torques.

    Sliders choose the time, the forces that are shown, and the joint whose force is drawn over time. The page is
    served on this computer alone until Ctrl-C.

    For example:
      forcegp view run test.h5 --shapes arm.urdf
      forcegp view log.h5 --html log.html
    """

    interrupted = "the page is closed"

    shown: Annotated[Positional[tuple[Path, ...]], EXISTING, arg(metavar="[RUN] DATA")]
    """A dataset (HDF5), and before it, if wished, the folder of a model."""
    shapes: Annotated[Path | None, URDF, unless_given("ROBOT.urdf", "capsules")] = None
    """What the links look like: a URDF with visual elements, its meshes beside it."""
    start: Annotated[float, arg(metavar="S")] = 0.0
    """Where in the recording to begin, in s."""
    seconds: Annotated[float, arg(metavar="S")] = 10.0
    """How much of it to show."""
    port: Annotated[int | None, unless_given("PORT", "a free one", int)] = None
    """Where the page is served."""
    html: Annotated[Path | None, unless_given("FILE.html", "no file")] = None
    """Write the scene to this file instead of serving it."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Serve, or write."""
        if len(self.shown) not in (1, 2):
            raise InvalidInput(f"{len(self.shown)} paths were given; give a dataset, or a model and a dataset.")
        *runs, data = self.shown
        run = runs[0] if runs else None
        self.require_free_file(self.html, forcegp.report.is_page, "a report")
        posterior = None if run is None else forcegp.load_posterior(run)
        recorded = forcegp.report.recorded_scene(
            forcegp.Dataset.load(data), posterior, start=self.start, seconds=self.seconds, shapes=self.shapes
        )
        for doubt in recorded.doubts:
            terminal.warn(doubt)
        if self.html is not None:
            title = f"{data.name}, {recorded.time[-1]:.3g} s" + (
                "" if run is None else f", with the forces of {run.name}"
            )
            notes = forcegp.report.scene_notes(recorded)
            page = forcegp.report.Page(
                title, recorded.robot.name, scene=forcegp.report.recording(recorded), scene_notes=notes
            )
            forcegp.report.write_page(self.html, page, overwrite=self.overwrite)
            terminal.note(f"page: {self.html}")
        else:
            forcegp.report.serve(
                recorded, port=self.port, ready=lambda url: terminal.note(f"open {url}; Ctrl-C ends it")
            )
        forces = [{"name": each.title, "unit": each.unit, "arrows": list(each.names)} for each in recorded.arrows]
        written = {} if self.html is None else {"html": str(self.html)}
        return {"rows": len(recorded.time), "seconds": float(recorded.time[-1]), "forces": forces, **written}
