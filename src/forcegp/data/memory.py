"""What the laws of a model remember at every row of a log, as more columns of u."""

from dataclasses import replace

import numpy as np
import torch

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput
from forcegp.model import Model


def with_memory(dataset: Dataset, model: Model) -> Dataset:
    """The log with the columns of u that `model.memory` names: one scan over each episode, from where it begins.

    Rows before the first reversal depend on that beginning, which no log tells. Raises InvalidInput for rows that are
    not in order of time, since a sample has no past.
    """
    memory = model.memory
    if not memory.names or dataset.u.shape[1] == len(model.inputs):
        return dataset
    if not dataset.time_ordered:
        raise InvalidInput(
            f"{', '.join(memory.titles)} remembers, and the rows are not in order of time; give the whole log."
        )
    columns = np.zeros((len(dataset), len(memory.names)))
    for episode in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == episode)
        q, time = (torch.as_tensor(np.array(x[rows]), device=model.robot.device) for x in (dataset.q, dataset.time))
        columns[rows] = memory.along(q, time).cpu().numpy()
    first = model.inputs.index(memory.names[0])
    u = np.concatenate([dataset.u[:, :first], columns, dataset.u[:, first:]], axis=1)
    return replace(dataset, u=u, model=model.known)
