"""The robot and its learned forces live in a browser: time, what is shown, and one joint's force over time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from forcegp.report.motion import Arrows, RecordedScene
from forcegp.report.scene import SceneNodes, viser_server

TICK = 1.0 / 30.0  # s between two frames


def serve(
    recorded: RecordedScene,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    ready: Callable[[str], None] | None = None,
    until: Callable[[], bool] = lambda: False,
) -> None:
    """Show the scene at http://host:port until `until()` is true, or for ever.

    `ready(url)` is called when the page can be opened. The default host is this computer alone.
    Raises MissingExtra without viser.
    """
    with viser_server(host, port) as server:
        controls = Controls(server, recorded)
        if ready is not None:
            ready(f"http://{host}:{server.get_port()}")
        while not until():
            controls.tick(TICK)
            time.sleep(TICK)


class Controls:
    """The sliders beside the scene."""

    def __init__(self, server: Any, recorded: RecordedScene) -> None:
        self.recorded, self.nodes = recorded, SceneNodes(server, recorded)
        gui, rows = server.gui, recorded.time
        self.playing = gui.add_checkbox("play", initial_value=len(rows) > 1)
        self.speed = gui.add_slider("speed", min=0.1, max=3.0, step=0.1, initial_value=1.0)
        end = max(float(rows[-1]), 1e-3)
        self.time = gui.add_slider("time in s", min=0.0, max=end, step=end / 1000.0, initial_value=0.0)
        self.row = 0
        self.time.on_update(lambda _: self.at(self.time.value))
        for place, group in enumerate(recorded.arrows):
            with gui.add_folder(group.title):
                shown = gui.add_checkbox("shown", initial_value=True)
                shown.on_update(lambda _, place=place, shown=shown: self.nodes.show_group(place, shown.value, self.row))
                gui.add_markdown(f"{group.largest:.3g} {group.unit} would be {recorded.arrow_length:.2g} m long")
                self._curve(gui, group)

    def at(self, seconds: float) -> None:
        """Show the row at that time."""
        self.row = int(np.searchsorted(self.recorded.time, seconds).clip(0, len(self.recorded.time) - 1))
        self.nodes.show(self.row)

    def tick(self, seconds: float) -> None:
        """Go on by so many seconds, at the chosen speed, and begin again after the end."""
        if self.playing.value:
            later = self.time.value + self.speed.value * seconds
            self.time.value = 0.0 if later > self.recorded.time[-1] else later

    def _curve(self, gui: Any, group: Arrows) -> None:
        """The force of one joint over time, with its 95 % interval, and a slider for the joint."""

        def data(place: int) -> tuple[np.ndarray, ...]:
            mean, half = group.mean[:, place], group.half[:, place]
            values = (self.recorded.time, mean, mean - half, mean + half)
            return tuple(np.ascontiguousarray(each, dtype=np.float64) for each in values)

        lines = [{"label": "t in s"}, {"label": group.unit, "stroke": "#0072b2", "width": 2}]
        lines += [{"label": end, "stroke": "#9cc6e0", "width": 1} for end in ("2.5 %", "97.5 %")]
        plot = gui.add_uplot(data(0), tuple(lines), title=group.names[0], aspect=1.4, scales={"x": {"time": False}})
        if len(group.names) > 1:
            joint = gui.add_slider("joint", min=1, max=len(group.names), step=1, initial_value=1)

            def choose(_: Any) -> None:
                plot.data, plot.title = data(joint.value - 1), group.names[joint.value - 1]

            joint.on_update(choose)
