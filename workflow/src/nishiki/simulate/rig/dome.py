"""A simulated dome with the protocol <3,n>, and the diodes that it lights."""

from collections.abc import Callable
from pathlib import Path

from nishiki.simulate.rig.line import SimulatedLine


class SimulatedDome(SimulatedLine):
    """A dome of light-emitting diodes.

    Parameters
    ----------
    path : Path
        As of `SimulatedLine`.
    count : int
        Number of diodes; the first has the number 0.
    on_shutter : callable, optional
        Action of the camera on the shutter cable, given the diodes that are lit.
    on_light : callable, optional
        Function that is called when the lit diodes have changed, before the dome answers.

    Attributes
    ----------
    lit : set of int
        The diodes that shine.
    dead : set of int
        Diodes that have failed: the dome says that they shine, and they do not.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        on_shutter: Callable[[set[int]], None] | None = None,
        on_light: Callable[[set[int]], None] | None = None,
    ) -> None:
        self.count, self.on_shutter, self.on_light = count, on_shutter, on_light
        self.lit: set[int] = set()
        self.dead: set[int] = set()
        super().__init__(path)

    def greet(self) -> list[str]:
        self.lit = set(range(self.count))  # all diodes shine when it starts
        return ["<UV Turned off.>", "<All lights turned on.>", "====", "RTI-Dome intialized", "Software Version: 1.0"]

    def ends(self, text: str) -> bool:
        return text.endswith(">")

    def obey(self, command: str) -> list[str]:
        name, _, value = command.strip("<>").partition(",")
        off = ["<UV Turned off.>", "<All lights turned off.>"]
        if name == "0":
            self._light(set())
            return off
        if name == "3" and value.isdigit():
            number = int(value)
            self._light({number} if number < self.count else set())
            return [*off, f"<Single LED turned on, number: {number}, row: {number // 8}, column: {number % 8}>"]
        if name == "6":
            if self.on_shutter is not None:
                self.on_shutter(self.lit - self.dead)
            return ["<Shutter triggered.>"]
        return [f"<INCORRECT FUNCTION CALL: {name}>"]

    def _light(self, diodes: set[int]) -> None:
        self.lit = diodes
        if self.on_light is not None:
            self.on_light(diodes - self.dead)
