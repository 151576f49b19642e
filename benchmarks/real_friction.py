"""Friction that remembers against its rivals, on logs of real robots that nobody here made.

    python -m benchmarks.real_friction ../shared/realdata [panda|tx40|tiago|go2|lbr|emps|dfki|triple ...]

A line per robot: root mean square of what models leave on unseen rows, over all joints: torque, of the two pendulums
accelerations over their deviation. All models have all training rows. GP and network learn what least squares leaves.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import gpytorch
import numpy as np
import torch
from tests.evidence import realdata

from forcegp import Dataset, Model, Torques, fit
from forcegp.data import with_memory
from forcegp.evidence import Accelerations, motion_residuals
from forcegp.forces import Actuation, RigidBodies, parse_forces

LAWS = {"least squares": "coulomb", "gear, no memory": "gear:memory=false", "gear": "gear"}
POINTS, PAST, EPOCHS, ROWS = 500, 60, 20, 4000  # of the GP; steps that the network sees; its passes; rows it learns


def unseen(folder: Path, name: str) -> tuple[Dataset, Dataset]:
    """Rows to learn from, and others: two runs, every third piece, or two of five blocks."""
    if name == "dfki":
        model = realdata.dfki_system(folder)
        runs = (143524, 143601, 143704, 144115), (143339, 143747)
        return realdata.dfki(folder, model, *runs[0]), realdata.dfki(folder, model, *runs[1])
    if name == "panda":
        return realdata.panda(folder, realdata.panda_system(folder))
    log = getattr(realdata, name)(folder)
    return log if isinstance(log, tuple) else realdata.blocks(log)


def gaussian_process(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of every column of y, from evenly spread rows."""
    some, found = np.linspace(0, len(x) - 1, min(POINTS, len(x))).astype(int), []
    X, there = torch.tensor(x[some]), torch.tensor(at)
    for target in torch.tensor(y[some].T):
        kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[1])).double()
        raw = [*kernel.parameters(), noise := torch.zeros((), dtype=torch.float64, requires_grad=True)]
        search, weights = torch.optim.Adam(raw, lr=0.1), target[:, None]
        for step in range(61):
            K = kernel(X).to_dense() + noise.exp() * torch.eye(len(X))
            lower = torch.linalg.cholesky(K)
            weights = torch.cholesky_solve(target[:, None], lower)
            if step < 60:
                search.zero_grad()
                (0.5 * target @ weights[:, 0] + lower.diagonal().log().sum()).backward()
                search.step()
        found.append((kernel(there, X).to_dense() @ weights)[:, 0].detach().numpy())
    return np.stack(found, 1)


def network(x: np.ndarray, y: np.ndarray, number: np.ndarray, at: np.ndarray, at_number: np.ndarray) -> np.ndarray:
    """A recurrent network (GRU, 32 units) on past rows of each record; NaN where it was not asked."""
    stride = max(1, len(x) // ROWS)

    def windows(number: np.ndarray) -> torch.Tensor:
        rows = np.arange(PAST * stride, len(number), stride)
        rows = rows[number[rows] == number[rows - PAST * stride]]
        return torch.tensor(rows[:, None] - stride * np.arange(PAST)[::-1])

    torch.manual_seed(0)
    cell, out = torch.nn.GRU(x.shape[1], 32, batch_first=True), torch.nn.Linear(32, y.shape[1])
    search = torch.optim.AdamW([*cell.parameters(), *out.parameters()], lr=3e-3, weight_decay=1e-3)
    X, Y, Z = (torch.tensor(each, dtype=torch.float32) for each in (x, y, at))
    own, there = windows(number), windows(at_number)
    learned, checked = own[: int(0.85 * len(own))], own[int(0.85 * len(own)) :]
    best, found = np.inf, np.full((len(at), y.shape[1]), np.nan)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(learned)).split(128):
            search.zero_grad()
            (out(cell(X[learned[batch]])[0][:, -1]) - Y[learned[batch][:, -1]]).square().mean().backward()
            search.step()
        with torch.no_grad():
            loss = float((out(cell(X[checked])[0][:, -1]) - Y[checked[:, -1]]).square().mean())
            if loss < best:
                best, found[there[:, -1]] = loss, out(cell(Z[there])[0][:, -1]).numpy()
    return found


def main(words: list[str]) -> None:
    """Run what is named, or all of it."""
    if not words:
        sys.exit(__doc__)
    folder, names = Path(words[0]), words[1:] or ["panda", "tx40", "tiago", "go2", "lbr", "emps", "dfki", "triple"]
    for name in names:
        accelerations = name in ("dfki", "triple")
        train, test = unseen(folder, name)
        model, left, seconds = Model(train.model.robot, (), (Actuation(), RigidBodies("all"))), {}, time.process_time()
        residuals, found = {}, None
        for title, dry in LAWS.items():
            evidence = Accelerations() if accelerations else Torques()
            laws = f"viscous,{dry},offset" + ("" if name in ("emps", "triple") else ",rotor")
            found = fit(model.with_forces(parse_forces(laws)), train, evidence)
            seen = [with_memory(rows, found.model) for rows in (train, test)]
            residuals[title] = [motion_residuals(rows, found.model)[accelerations] for rows in seen]
        own, other = residuals["least squares"]
        x, z = (np.concatenate([d.q, d.v, d.u if accelerations else d.a], 1) for d in (train, test))
        middle, size, scale = x.mean(0), x.std(0) + 1e-9, own.std(0) + 1e-12
        x, z, y, half = (x - middle) / size, (z - middle) / size, own / scale, 2 * train.nv
        left = {title: each[1] for title, each in residuals.items()}
        left["GP"] = other - scale * gaussian_process(x[:, :half], y, z[:, :half])
        left["network"] = other - scale * network(x, y, train.episode, z, test.episode)
        weight = 1.0 / test.a.std(0) if accelerations else 1.0
        rms = {title: np.sqrt(np.nanmean(np.square(weight * each))) for title, each in left.items()}
        base = dict.fromkeys(rms, rms["least squares"])
        base["network"] = np.sqrt(np.square(weight * other)[~np.isnan(left["network"])].mean())
        assert found is not None, "there are laws"
        parts = found.settings["gear_friction"]
        who = sum("memory" in each for each in parts["parts"].values())
        shown = ", ".join(f"{title} {value / base[title]:.3f}" for title, value in rms.items())
        print(f"{name}: {rms['least squares']:.4g} left by least squares; of it {shown}; {who} of {train.nv} joints "
              f"remember{', motors coupled' if 'transmission' in parts else ''}; "
              f"{time.process_time() - seconds:.0f} CPU s", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
