"""A robot that moves in the browser, with the force that touches it (viser, pip install 'forcegp[view]')."""

import numpy as np
import torch
import viser
from scipy.spatial.transform import Rotation

from forcegp.report.shapes import link_shapes, poses_of_links

METRES_PER_NEWTON, FRAMES = 0.01, 30.0


class LiveView:
    """Shows `robot` at http://localhost:8080, at most 30 times per second of the recording."""

    def __init__(self, robot, port=8080):
        self.robot, self.shown = robot, -np.inf
        self.server = viser.ViserServer(port=port)
        shapes, _ = link_shapes(robot)
        add = self.server.scene.add_mesh_simple
        self.links = {x.link: add(f"/{x.link}", x.vertices.astype(np.float32), x.faces, opacity=0.6) for x in shapes}
        self.arrow = self.server.scene.add_arrows("/force", np.zeros((1, 2, 3)), (213, 94, 0), visible=False)

    def show(self, time, q, place=None):
        """The robot at q, and the force at its `place`, which ends at the point that it pushes."""
        if time - self.shown < 1.0 / FRAMES:
            return
        self.shown, self.arrow.visible = time, place is not None
        for node, pose in zip(
            self.links.values(), poses_of_links(self.robot, torch.tensor(q[None]), [*self.links])[0], strict=True
        ):
            node.wxyz, node.position = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True), pose[:3, 3]
        if place:
            pose = poses_of_links(self.robot, torch.tensor(q[None]), [place.link])[0, 0]
            end = pose[:3, :3] @ place.point + pose[:3, 3]
            self.arrow.points = np.array([[end - METRES_PER_NEWTON * np.array(place.force), end]], np.float32)
