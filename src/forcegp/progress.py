"""How far long work is: it `tell`s so wherever it is, and who watches it hears; no argument carries that through."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[int, int, str], None]
"""Called as `listener(done, total, note)`, now and then, by work of the same thread."""

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def watched(listener: Listener | None) -> Iterator[None]:
    """Within it the listener hears what work tells: `with watched(print): fit(model, log)`; None hears nothing."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def part(number: int, parts: int, note: str = "") -> Iterator[None]:
    """Within it, what is told counts as the share `number` (from 0) of so many equal ones, behind this note."""
    listener = _listener.get()

    def scaled(done: int, total: int, inner: str) -> None:
        if listener is not None:
            listener(number * total + done, parts * total, f"{note}{inner}")

    tell(number, parts, note)
    with watched(scaled):
        yield


def tell(done: int, total: int, note: str = "") -> None:
    """So much of the work is done."""
    if (listener := _listener.get()) is not None:
        listener(done, total, note)
