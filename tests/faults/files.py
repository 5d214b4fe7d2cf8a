"""Files that are not what they were: flipped bits, torn tails, deleted and swapped files, a changed capture."""

import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from arena import Arena
from outcome import Outcome, judged

from nishiki.processes import host


def by_stage(arena: Arena) -> dict[str, list[Path]]:
    """Files of the undisturbed results, the facts of the run apart, by scene and stage."""
    found: dict[str, list[Path]] = {}
    for name in sorted(arena.reference):
        found.setdefault("/".join(name.split("/")[:2]), []).append(arena.results / name)
    return found


def damaged(
    arena: Arena,
    numbers: random.Random,
    amount: int,
    spoil: Callable[[Path, list[Path], random.Random], tuple[Path, ...]],
) -> Iterator[Outcome]:
    """Rounds of damage, one file in every artifact at once; verify must name each.

    spoil: (file, all files of the artifact, numbers) -> the files that were spoilt, none where it cannot be done.
    """
    for _ in range(amount):
        arena.restore()
        struck = {}
        for stage, files in by_stage(arena).items():
            spoilt = spoil(numbers.choice(files), files, numbers)
            if spoilt:
                struck[stage] = names_of(spoilt)
        told = arena.verify("--set-aside").stdout
        named = {stage: any(name in told for name in names) for stage, names in struck.items()}
        last = judged(arena, "all", detected=True, told=told)
        for stage, was_named in named.items():
            yield Outcome(
                stage.split("/")[1],
                was_named,
                last.recovered,
                0,
                last.wrong,
                "" if was_named else told + str(struck[stage]),
            )
        if not last.recovered:
            yield last


def flipped_bits(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """One bit of one file of every artifact, at a random place."""

    def flip(path: Path, files: list[Path], numbers: random.Random) -> tuple[Path, ...]:
        size = path.stat().st_size
        if not size:
            return ()
        place, bit = numbers.randrange(size), numbers.randrange(8)
        with open(path, "r+b") as file:
            file.seek(place)
            value = file.read(1)[0]
            file.seek(place)
            file.write(bytes([value ^ 1 << bit]))
        return (path,)

    yield from damaged(arena, numbers, amount, flip)


def names_of(spoilt: tuple[Path, ...]) -> list[str]:
    """What of spoilt files a message must show: one of their names below the results. Where the manifest is among them,
    it or the facts of the run beside it, as each proves the other."""
    facts = [path.with_name("run.json") for path in spoilt if path.name == "artifact.json"]
    return ["/".join(path.parts[path.parts.index("results") :]) for path in (*spoilt, *facts)]


def lost_power(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Tails that never reached the disk: cut off, or of the full length and zero."""

    def cut(path: Path, files: list[Path], numbers: random.Random) -> tuple[Path, ...]:
        size = path.stat().st_size
        keep = numbers.randrange(size) if size else 0
        rest = path.read_bytes()[keep:]
        if not rest.strip(b"\0"):
            return ()
        with open(path, "r+b") as file:
            file.truncate(keep)
            if numbers.random() < 0.5:
                file.truncate(size)
        return (path,)

    yield from damaged(arena, numbers, amount, cut)
    yield from unfinished(arena, numbers, amount)


def unfinished(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Artifacts that were being written: their folder has its temporary name, files are cut or missing."""
    for _ in range(amount):
        arena.restore()
        victims = numbers.sample(arena.artifacts(), min(6, len(arena.artifacts())))
        names = [victim.relative_to(arena.results).as_posix() for victim in victims]
        for victim in victims:
            dead = f"{2**22 + numbers.randrange(1000)}-{numbers.randrange(10**6)}"  # no process has such a number
            partial = victim.with_name(f".{victim.name}.{host()}.{dead}.partial")
            victim.rename(partial)
            for path in sorted(partial.rglob("*")):
                if path.is_file() and numbers.random() < 0.5:
                    os.truncate(path, numbers.randrange(path.stat().st_size + 1))
                elif path.is_file() and numbers.random() < 0.3:
                    path.unlink()
        sound = [file for file in arena.reference if not any(file.startswith(name + "/") for name in names)]
        told = f"{len(names)} unfinished" in arena.verify().stdout
        last = judged(arena, "all", detected=told, sound=sound)
        left = list(arena.results.glob("*/*/.*.partial"))
        for name in names:
            told = "" if not left else f"left behind: {left}"
            yield Outcome(name.split("/")[1], last.detected, last.recovered and not left, last.lost, last.wrong, told)


def deleted_files(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """One file of every artifact gone: a run by itself must notice and mend it."""
    for _ in range(amount):
        arena.restore()
        gone = {}
        for stage, files in by_stage(arena).items():
            victim = numbers.choice(files)
            victim.unlink()
            gone[stage] = victim
        told = arena.run()
        now = arena.digests()
        wrong = sum(arena.reference.get(name) != value for name, value in now.items())
        whole = told.returncode == 0 and len(now) == len(arena.reference) and not wrong
        for stage, victim in gone.items():
            named = victim.parent.name in told.stdout or any(part in told.stdout for part in victim.parts[-3:])
            yield Outcome(stage.split("/")[1], named, whole, 0, wrong, "" if named and whole else told.stdout[-2000:])


def swapped_files(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Two files of one artifact change places, of one size where there are such."""

    def swap(path: Path, files: list[Path], numbers: random.Random) -> tuple[Path, ...]:
        content = path.read_bytes()
        others = [other for other in files if other != path and other.read_bytes() != content]
        alike = [other for other in others if other.stat().st_size == len(content)]
        if not others:
            return ()
        other = numbers.choice(alike or others)
        path.write_bytes(other.read_bytes())
        other.write_bytes(content)
        return path, other

    yield from damaged(arena, numbers, amount, swap)


def swapped_artifacts(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Two whole artifacts of different stages change places."""
    for _ in range(amount):
        arena.restore()
        first, second = numbers.sample(arena.artifacts(), 2)
        aside = first.with_name("aside")
        first.rename(aside)
        second.rename(first)
        aside.rename(second)
        told = arena.verify("--set-aside").stdout
        for path in (first, second):
            name = path.relative_to(arena.results).as_posix()
            yield judged(arena, name.split("/")[1], detected=name in told, told=told)


def damaged_inputs(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """A flipped bit in what a stage reads, the stage itself yet to be made: it must refuse, or not have used it."""
    for _ in range(amount):
        for scene in arena.scenes:
            arena.restore()
            stages = sorted(path for path in arena.artifacts() if path.parts[-3] == scene)
            last = max(stages, key=lambda path: len(path.parent.name) * 0 + path.stat().st_mtime)
            others = [path for path in stages if path != last]
            victim = numbers.choice(others)
            path = numbers.choice([file for file in victim.rglob("*") if file.is_file() and file.stat().st_size])
            for folder in others:
                if folder != victim and numbers.random() < 0.5:
                    shutil.rmtree(folder)
            shutil.rmtree(last)
            content = bytearray(path.read_bytes())
            content[numbers.randrange(len(content))] ^= 1 << numbers.randrange(8)
            path.write_bytes(content)
            done = arena.run()
            now = arena.digests()
            spoilt = victim.relative_to(arena.results).as_posix()
            wrong = sum(
                arena.reference.get(name) != value for name, value in now.items() if not name.startswith(spoilt + "/")
            )
            arena.verify("--set-aside")
            outcome = judged(arena, victim.parent.name, detected=not wrong, told=done.stdout)
            yield Outcome(
                outcome.where, outcome.detected, outcome.recovered, outcome.lost, wrong + outcome.wrong, outcome.told
            )


def changed_capture(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """A sealed capture is changed, before anything was made of it: the run must refuse and name the file."""
    for _ in range(amount):
        for scene in arena.scenes:
            folder = arena.folder / "captures" / scene
            path = numbers.choice(sorted(file for file in (folder / "data").rglob("*") if file.is_file()))
            sound = path.read_bytes()
            os.chmod(path, 0o644)
            path.write_bytes(spoilt(sound, numbers))
            shutil.rmtree(arena.results / scene, ignore_errors=True)
            done = arena.run()
            verified = arena.nishiki("verify", "--capture", f"captures/{scene}", "results")
            named = path.name in verified.stdout
            wrong = sum(arena.reference.get(name) != value for name, value in arena.digests().items())
            path.write_bytes(sound)
            outcome = judged(arena, f"capture of {scene}", detected=named, told=done.stdout)
            yield Outcome(outcome.where, named, outcome.recovered, outcome.lost, outcome.wrong + wrong, outcome.told)


def spoilt(content: bytes, numbers: random.Random) -> bytes:
    """One bit flipped, or the end cut off."""
    if numbers.random() < 0.5:
        place = numbers.randrange(len(content))
        return content[:place] + bytes([content[place] ^ 1 << numbers.randrange(8)]) + content[place + 1 :]
    return content[: numbers.randrange(len(content))]


KINDS = {
    "lost power": lost_power,
    "flipped bit": flipped_bits,
    "deleted file": deleted_files,
    "swapped files": swapped_files,
    "swapped artifacts": swapped_artifacts,
    "flipped bit in an input": damaged_inputs,
    "changed capture": changed_capture,
}
