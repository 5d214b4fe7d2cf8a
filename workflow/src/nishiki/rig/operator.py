"""What a person at the rig does by hand: asked for on the terminal, and refused where nobody can answer."""

from __future__ import annotations

import sys

from nishiki.rig.device import DeviceError


def ask_operator(device: str, request: str) -> None:
    """Ask the person at the terminal to do something, and wait until they press Enter.

    Raises DeviceError where the program has no terminal to ask on.
    """
    if not sys.stdin.isatty():
        raise DeviceError(
            f"{device}: {request}: nobody can be asked, since the program runs without a terminal. "
            "Remedy: run it in a terminal, or name a device in the rig's description that does this by itself"
        )
    print(f"{device}: {request}, then press Enter ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise DeviceError(f"{device}: {request}: the terminal was closed. Remedy: run the same command again")


class PromptedPolariser:
    """A polariser that a person turns.

    Parameters
    ----------
    name : str
        Name in messages.
    states : tuple of str
        The states that it has, named as in frames.csv.
    """

    def __init__(self, name: str, states: tuple[str, ...]) -> None:
        self.name, self.states = name, states
        self.state: str | None = None

    def set(self, state: str) -> None:
        """Ask for a state, unless it was the last that was asked for."""
        expect_state(self.name, state, self.states)
        if state != self.state:
            self.state = None
            ask_operator(self.name, f"set the polariser to '{state}'")
            self.state = state

    def close(self) -> None:
        """Nothing is held."""


def expect_state(name: str, state: str, states: tuple[str, ...]) -> None:
    """Raise DeviceError where a polariser has no such state."""
    if state not in states:
        raise DeviceError(
            f"{name}: expected one of the states {', '.join(states)}, found '{state}'. "
            "Remedy: correct the plan, or the states in the description of the rig"
        )
