"""Seeded mutations of files, for the short form of the fuzzing that needs no instrumentation."""

from __future__ import annotations

import random
import re
import struct

from fuzz.targets import TOKENS

NUMBER = re.compile(rb"\d+")


def mutations(seeds: list[bytes], count: int, *, seed: int):
    """The seeds themselves, then `count` changed ones; the same for the same seed."""
    chance = random.Random(seed)
    yield from seeds
    for _ in range(count):
        data = bytearray(chance.choice(seeds))
        for _ in range(chance.choice((1, 1, 1, 2, 3, 8))):
            data = bytearray(chance.choice(CHANGES)(data, chance, seeds))
        yield bytes(data)


def _flip(data, chance, seeds):
    if data:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return data


def _token(data, chance, seeds):
    place = chance.randrange(len(data) + 1)
    over = place + chance.choice((0, 0, 1, 4))
    return data[:place] + chance.choice(TOKENS) + data[over:]


def _cut(data, chance, seeds):
    place = chance.randrange(len(data) + 1)
    return data[:place] if chance.random() < 0.5 else data[:1] + data[place:]


def _repeat(data, chance, seeds):
    first = chance.randrange(len(data) + 1)
    part = data[first : first + chance.choice((1, 8, 64, 512))]
    return data[:first] + part * chance.choice((2, 3, 50, 1000)) + data[first:]


def _splice(data, chance, seeds):
    other = chance.choice(seeds)
    return data[: chance.randrange(len(data) + 1)] + other[chance.randrange(len(other) + 1) :]


def _number(data, chance, seeds):
    found = list(NUMBER.finditer(bytes(data)))
    if not found:
        return _flip(data, chance, seeds)
    where = chance.choice(found)
    value = chance.choice((b"0", b"-1", b"65536", b"4294967296", b"9" * 30, b"1e400", b"nan", b"1" * 5000, b""))
    return data[: where.start()] + value + data[where.end() :]


def _binary(data, chance, seeds):
    form = chance.choice(("<I", ">I", "<H", ">H", "<Q", "B"))
    size = struct.calcsize(form)
    if len(data) <= size + 1:
        return data
    place = chance.randrange(1, len(data) - size)
    value = chance.choice(
        (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (4 * size), chance.getrandbits(8 * size))
    )
    data[place : place + size] = struct.pack(form, value)
    return data


CHANGES = (_flip, _flip, _token, _token, _cut, _repeat, _splice, _number, _number, _binary, _binary)
