"""What became of one fault."""

from collections.abc import Iterable
from dataclasses import dataclass

from arena import Arena


@dataclass(frozen=True)
class Outcome:
    """One fault: where it struck, and the answers. lost and wrong count artifacts."""

    where: str
    detected: bool
    recovered: bool
    lost: int
    wrong: int
    told: str = ""
    tried: int = 1


def judged(arena: Arena, where: str, *, detected: bool, sound: Iterable[str] = (), told: str = "") -> Outcome:
    """Run to the end and compare with the undisturbed run. sound: files that were finished and sound before the fault.

    What stands there afterwards must be all files of the reference with their bytes; extra files count as wrong.
    """
    before = arena.digests()
    lost = {name.rsplit("/", 1)[0] for name in sound if before.get(name) != arena.reference[name]}
    done = arena.run()
    after = arena.digests()
    gone = {name for name in arena.reference if name not in after}
    other = {name for name in after if arena.reference.get(name) != after[name]}
    recovered = done.returncode == 0 and not gone and not other
    return Outcome(
        where, detected, recovered, len(lost), len(other), "" if recovered and detected else told + done.stdout[-2000:]
    )


def stage_of(name: str) -> str:
    """Stage of a file named below the results."""
    return name.split("/")[1]
