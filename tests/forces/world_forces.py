"""Forces at a contact along all axes of the world, one of which no acceleration shows."""

from dataclasses import dataclass

import torch

from forcegp.forces import ToolForces


@dataclass(frozen=True)
class WorldForces(ToolForces):
    """Along x, y and z of the world, the last of which is the normal of a table."""

    def latent_names(self, robot):
        return "force-x", "force-y", "force-z"

    def labels(self, robot):
        return {"velocity": ("along x", "along y", "along z")}

    def _directions(self, dynamics, where):
        return torch.eye(3).to(where.orientation).expand_as(where.orientation)
