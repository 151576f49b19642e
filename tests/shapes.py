"""What `FORCEGP_CHECK_SHAPES=1` does: what annotations of forcegp promise is checked where functions are called.

A call whose arguments do not fit has to be refused by forcegp itself, with an error of its own; one that is computed
instead, or fails in another way, is an error here. So tests of wrong arguments pass, and every annotation is checked.
Of a dataclass, the fields are checked once they are there: its constructor may convert what it is given.
"""

import contextlib
import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from beartype.door import is_bearable
from jaxtyping import TypeCheckError, install_import_hook, jaxtyped

CONFIGURATION = BeartypeConf(is_pep484_tower=True)  # an int is a float, as for type checkers


class MisfitError(AssertionError):  # which nothing takes for an argument's fault
    """What an annotation promises is not so, and forcegp did not refuse it."""


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Without checks in this block, as users have it; not to be nested."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def checked(definition: Any) -> Any:
    """The function or class whose calls are checked."""
    if not inspect.isclass(definition):
        return checked_function(definition)
    if {"__dataclass_fields__", "__init__"} <= vars(definition).keys():
        definition.__init__ = checked_constructor(definition, definition.__init__)
    return definition


def checked_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """As that of jaxtyping, but what does not fit may be refused by the function itself."""

    @functools.cache
    def fitting() -> Callable[..., Any]:  # made at the first call: most functions are not called
        return jaxtyped(function, typechecker=beartype(conf=CONFIGURATION))

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        try:
            return fitting()(*args, **kwargs)
        except TypeCheckError as error:  # of this call: those inside are misfits
            misfit = MisfitError(str(error))
        if "checking the parameters of" in str(misfit):
            from forcegp.errors import ForceGPError

            with unchecked():
                try:
                    function(*args, **kwargs)
                except ForceGPError:
                    raise
                except Exception as error:
                    raise misfit from error
        raise misfit

    return call


def checked_constructor(kind: type, construct: Callable[..., None]) -> Callable[..., None]:
    """A constructor may convert what it is given, or refuse it: the fields count that it leaves."""

    @functools.cache
    def hints() -> dict[str, Any]:
        """Of the fields, without those that a class of another library brings, or that are computed when asked for."""
        package, found = kind.__module__.split(".")[0], get_type_hints(kind, include_extras=True)
        bases = [base for base in kind.__mro__ if base.__module__.split(".")[0] == package]
        own = {name for base in bases for name in inspect.get_annotations(base)}
        own -= {name for name in own if isinstance(inspect.getattr_static(kind, name, None), functools.cached_property)}
        return {field.name: found[field.name] for field in dataclasses.fields(kind) if field.name in own}

    @functools.wraps(construct)
    def call(made: Any, *args: Any, **kwargs: Any) -> None:
        construct(made, *args, **kwargs)
        if jaxtyping.config.jaxtyping_disable or type(made).__init__ is not kind.__init__:
            return
        with jaxtyped("context"):
            for name, hint in hints().items():
                value = getattr(made, name)
                if not is_bearable(value, hint, conf=CONFIGURATION):
                    raise MisfitError(f"{kind.__qualname__}.{name} is {value!r}, not {hint}")

    return call


def install() -> None:
    """Check forcegp, before its first import."""
    jaxtyping.jaxtyped = lambda **_: checked  # what the hook puts on every function and class
    install_import_hook("forcegp", None)
