"""Addresses at which there is no cluster, and a real cluster of two nodes on this machine."""

import os
import socket

import pytest
from tests.parallel.two_nodes import two_nodes

os.environ["RAY_AUTH_MODE"] = "disabled"  # whether or not the home folder of whoever tests holds a token of Ray


@pytest.fixture
def dead_address():
    """A port of this machine on which nothing listens: bound, so that nobody else takes it, and not listening."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{taken.getsockname()[1]}"


@pytest.fixture
def silent_address():
    """A port of this machine that accepts connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture(scope="session")
def cluster():
    """The address of two nodes with one processor each; they are ended with the tests."""
    pytest.importorskip("ray")
    import ray

    with two_nodes() as address:
        yield address
        ray.shutdown()
