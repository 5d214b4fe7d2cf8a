"""Types of what the package uses of numba: a compiled function keeps the signature of its Python function."""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import types as types

F = TypeVar("F", bound=Callable[..., Any])

def njit(**options: Any) -> Callable[[F], F]: ...

prange = range

def set_num_threads(n: int) -> None: ...
def get_num_threads() -> int: ...
