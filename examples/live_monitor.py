"""Prints contacts while they happen: python examples/live_monitor.py RUN FREE.h5, and play_bag.py beside it."""

import json
import socket
import sys

import numpy as np
from live_view import LiveView
from play_bag import ADDRESS, FIELDS

from forcegp import ContactMonitor, Dataset, load_posterior


def contacts(monitor, player, view):
    """(time in s, place) when a contact begins, and when it is twice as far from free motion."""
    names, last, told = monitor.robot.joint_names, None, 0.0
    for row in map(json.loads, player.makefile()):
        if not row["position"].keys() >= {*names}:
            continue  # of a gripper, for example
        q, v, u = (np.array([row[field][name] for name in names]) for field in FIELDS)
        if last is not None and abs(row["time"] - last - monitor.dt) > 0.5 * monitor.dt:
            print(f"{row['time']:.3f} s: rows are missing before", file=sys.stderr)
            monitor.restart()
        last, state = row["time"], monitor(q, v, u)
        place = monitor.place(q, state.torque) if state.alarm else None
        told = told if place else 0.0
        if place and state.distance > 4.0 * told:
            told = float(state.distance)
            yield last, place
        view.show(last, q, place)


if __name__ == "__main__":
    posterior, free = load_posterior(sys.argv[1]), Dataset.load(sys.argv[2])
    monitor = ContactMonitor(posterior.predictor(), dt=float(free.time[1] - free.time[0]))
    monitor.calibrate([(free.q, free.v, free.u)])
    with socket.create_server(ADDRESS) as node, node.accept()[0] as player:
        for t, at in contacts(monitor, player, LiveView(monitor.robot)):
            print(f"{t:.3f} s: {at.link}, {np.linalg.norm(at.force):.1f} N (std {np.linalg.norm(at.force_std):.1f})")
