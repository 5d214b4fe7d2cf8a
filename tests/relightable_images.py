"""Relightable images as other programs write them, and the values of their pixels, each by a slow decoder."""

import io
import json
import math
import struct

import numpy as np
import pytest
from PIL import Image
from small_painting import dome

from nishiki.capture.convert import convert
from nishiki.capture.relightable import open_relightable
from nishiki.cli import main
from nishiki.formats.problems import CaptureError

ROWS, COLUMNS = 5, 7
SCALE, BIAS = [1.5, 0.75, 2.0, 1.25, 0.5, 1.0], [120, 100, 131, 127, 90, 3]
LIGHT = np.array([0.3, -0.5, math.sqrt(0.66)])


def random_codes(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def heading(layout, version="PTM_1.2"):
    numbers = f"{COLUMNS}\n{ROWS}\n{' '.join(map(str, SCALE))} \n{' '.join(map(str, BIAS))}\n"
    return f"{version}\n{layout}\n{numbers}".encode()


def polynomial(codes, light):
    """0 to 255 of six bytes, term by term."""
    u, v, _ = map(float, light)
    monomials = [u * u, v * v, u * v, u, v, 1.0]
    return sum(s * (int(c) - b) * m for s, c, b, m in zip(SCALE, codes, BIAS, monomials, strict=True))


def rgb_file():
    """Bytes, and the value (0 to 1) of a pixel and colour."""
    codes = random_codes(3, ROWS, COLUMNS, 6)  # rows from the bottom
    return heading(
        "PTM_FORMAT_RGB"
    ) + codes.tobytes(), lambda r, c, k: polynomial(codes[k, ROWS - 1 - r, c], LIGHT) / 255


def brightness_and_colour(terms, colours):
    """Of planes from the bottom."""
    return lambda r, c, k: polynomial(terms[ROWS - 1 - r, c], LIGHT) / 255 * int(colours[ROWS - 1 - r, c, k]) / 255


def lrgb_file():
    terms, colours = random_codes(ROWS, COLUMNS, 6), random_codes(ROWS, COLUMNS, 3, seed=1)
    return heading("PTM_FORMAT_LRGB") + terms.tobytes() + colours.tobytes(), brightness_and_colour(terms, colours)


def older_lrgb_file():
    terms, colours = random_codes(ROWS, COLUMNS, 6), random_codes(ROWS, COLUMNS, 3, seed=1)
    stored = b"".join(terms[r, c].tobytes() + colours[r, c].tobytes() for r in range(ROWS) for c in range(COLUMNS))
    return heading("PTM_FORMAT_LRGB", "PTM_1.1") + stored, brightness_and_colour(terms, colours)


def jpeg_file(transforms=(0, 0, 1), motion=0, count=9):
    """Stream 2 is the difference from stream 4 inverted, stream 0 that from stream 2; stream 1 has two corrections.

    count : 9 of LRGB, 18 of RGB.
    """
    streams, stored = [], []
    for plane in random_codes(count, ROWS, COLUMNS, seed=2):
        buffer = io.BytesIO()
        Image.fromarray(plane).save(buffer, "JPEG", quality=95)
        streams.append(buffer.getvalue())
        stored.append(np.asarray(Image.open(io.BytesIO(buffer.getvalue()))).astype(int))
    order, references = [5, 0, 3, 1, 2, 4, *range(6, count)], [2, -1, 4, *[-1] * (count - 3)]
    planes = [plane.copy() for plane in stored]
    planes[2] = (stored[2] + (255 - stored[4]) - 128) % 256
    planes[0] = (stored[0] + planes[2] - 128) % 256
    corrections = struct.pack(">IB", 8, 250) + struct.pack(">IB", ROWS * COLUMNS - 1, 7)
    planes[1][8 // COLUMNS, 8 % COLUMNS], planes[1][-1, -1] = 250, 7
    sizes, extra = [len(s) for s in streams], [0, len(corrections), *[0] * (count - 2)]
    lists = [[*transforms, *[0] * count][:count], [motion] * count, [0] * count, order, references, sizes, extra]
    layout = "PTM_FORMAT_JPEG_LRGB" if count == 9 else "PTM_FORMAT_JPEG_RGB"
    head = heading(layout) + b"90\n" + "".join(" ".join(map(str, each)) + "\n" for each in lists).encode()
    data = b"".join(stream + (corrections if i == 1 else b"") for i, stream in enumerate(streams))
    if count == 18:
        colours = [np.stack(planes[6 * k : 6 * k + 6], axis=-1) for k in range(3)]
        return head + data, lambda r, c, k: polynomial(colours[k][ROWS - 1 - r, c], LIGHT) / 255
    terms, colours = np.stack(planes[:6], axis=-1), np.stack(planes[6:], axis=-1)
    return head + data, brightness_and_colour(terms, colours)


def hsh_file(terms=9, line="\n"):
    codes = random_codes(ROWS, COLUMNS, 3, terms)  # rows from the top
    random = np.random.default_rng(5)
    scale, bias = random.uniform(0.5, 2, terms).astype("<f4"), random.uniform(-1, 0, terms).astype("<f4")
    head = line.join(["#HSH1.2", "# another", "3", f"{COLUMNS} {ROWS} 3", f"{terms} 2 1", ""]).encode()
    weights = harmonics_as_viewers_have_them(LIGHT)[:terms]

    def value(r, c, k):
        numbers = zip(codes[r, c, k], scale, bias, weights, strict=True)
        return sum((int(code) / 255 * float(s) + float(b)) * w for code, s, b, w in numbers)

    return head + scale.tobytes() + bias.tobytes() + codes.tobytes(), value


def harmonics_as_viewers_have_them(light):
    """Sixteen values, written out; lamps lower than 0.15 radians are taken for one that is as high."""
    turn, c = math.atan2(light[1], light[0]), max(light[2], math.cos(3.1415 / 2 - 0.15))
    s, pi = math.sqrt(c - c * c), math.pi
    cubic = 1 - 5 * c + 5 * c * c
    return [
        *(1 / math.sqrt(2 * pi), math.sqrt(6 / pi) * math.cos(turn) * s),
        *(math.sqrt(3 / (2 * pi)) * (2 * c - 1), math.sqrt(6 / pi) * math.sin(turn) * s),
        math.sqrt(30 / pi) * math.cos(2 * turn) * (c * c - c),
        math.sqrt(30 / pi) * math.cos(turn) * (2 * c - 1) * s,
        math.sqrt(5 / (2 * pi)) * (1 - 6 * c + 6 * c * c),
        math.sqrt(30 / pi) * math.sin(turn) * (2 * c - 1) * s,
        math.sqrt(30 / pi) * math.sin(2 * turn) * (c * c - c),
        2 * math.sqrt(35 / pi) * math.cos(3 * turn) * s**3,
        math.sqrt(210 / pi) * math.cos(2 * turn) * (2 * c - 1) * (c * c - c),
        2 * math.sqrt(21 / pi) * math.cos(turn) * s * cubic,
        math.sqrt(7 / (2 * pi)) * (-1 + 12 * c - 30 * c * c + 20 * c**3),
        2 * math.sqrt(21 / pi) * math.sin(turn) * s * cubic,
        math.sqrt(210 / pi) * math.sin(2 * turn) * (2 * c - 1) * (c * c - c),
        2 * math.sqrt(35 / pi) * math.sin(3 * turn) * s**3,
    ]


RELIGHT = [
    *(("ptm", "rgb", 18), ("ptm", "rgb", 9), ("ptm", "lrgb", 9), ("ptm", "lrgb", 6)),
    *(("hsh", "rgb", 27), ("hsh", "lrgb", 12), ("sh", "rgb", 27)),
    *(("rbf", "mrgb", 5), ("rbf", "mycc", (5, 2, 2)), ("rbf", "mycc", (3, 0, 0))),
    *(("bilinear", "mrgb", 6), ("bilinear", "mycc", (4, 4, 4)), ("bilinear", "mycc", (12, 3, 3))),
]
"""Kinds, colour spaces and numbers of planes; of mycc those of brightness and of each difference."""


def write_relight(folder, kind, space, count, rows=ROWS, columns=COLUMNS):
    """A folder of relight; returns info.json's content and its planes (rows, columns, planes) as JPEG keeps them."""
    folder.mkdir()
    split, count = (count, sum(count)) if space == "mycc" else (None, count)
    random, planes = np.random.default_rng(8), []
    for number in range(-(-count // 3)):
        picture = np.repeat(np.repeat(random.integers(0, 256, (-(-rows // 8), -(-columns // 8), 3)), 8, 0), 8, 1)
        picture = Image.fromarray(picture[:rows, :columns].astype(np.uint8))
        picture.save(folder / f"plane_{number}.jpg", quality=95, subsampling=0, keep_rgb=space != "rgb")
        with Image.open(folder / f"plane_{number}.jpg") as stored:
            planes.append(np.asarray(stored))
    material = {"scale": random.uniform(0.2, 1, count).tolist(), "bias": random.uniform(0, 0.6, count).tolist()}
    info = {"width": columns, "height": rows, "format": "jpg", "type": kind, "colorspace": space}
    info |= {"yccplanes": list(split)} if split else {"nplanes": count}
    info |= {"materials": [material], "lights": dome(6, 1).ravel().tolist(), "sigma": 0.4}
    if kind in ("rbf", "bilinear"):
        info |= {"resolution": 5} if kind == "bilinear" else {}
        info["basis"] = random.integers(0, 256, (count + 1) * (18 if kind == "rbf" else 75)).tolist()
        material["range"] = random.uniform(100, 400, count).tolist()
        Image.new("RGB", (32 * (count + 1), 32)).save(folder / "materials.png")  # as relight does
    (folder / "info.json").write_text(json.dumps(info))
    return info, np.concatenate(planes, axis=-1)[..., :count]


def relight_value(info, codes, light, k):
    """0 to 1 of a pixel's planes, term by term."""
    (material,), count = info["materials"], len(codes)
    numbers = [(int(c) / 255 - b) * s for c, b, s in zip(codes, material["bias"], material["scale"], strict=True)]
    x, y, z = map(float, light)
    if info["type"] in ("rbf", "bilinear"):
        weights = gaussians(info, light) if info["type"] == "rbf" else corners(info["resolution"], light)
        return components_value(info, numbers, weights, k)
    if info["type"] == "ptm":
        terms = [1, x, y, x * x, x * y, y * y]
    elif info["type"] == "hsh":
        terms = harmonics_as_viewers_have_them(light)[:9]
    else:
        terms = [0.282095, 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z]
        terms += [0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y)]
    if info["colorspace"] == "lrgb":
        return int(codes[k]) / 255 * sum(t * n for t, n in zip(terms[: count - 3], numbers[3:], strict=True))
    return sum(t * n for t, n in zip(terms[: count // 3], numbers[k::3], strict=True))


def gaussians(info, light):
    """{number of a captured light: weight}."""
    lights = np.reshape(info["lights"], (-1, 3))
    weights = [math.exp(-sum((each - light) ** 2) / info["sigma"] ** 2) for each in lights]
    kept = {i: w for i, w in enumerate(weights) if w > 0.001 * sum(weights)}
    return {i: w / sum(kept.values()) for i, w in kept.items()}


def corners(side, light):
    """{place in a grid, column by column of each row: weight} of the four nodes around a light."""
    x, y, z = map(float, light)
    length = abs(x) + abs(y) + abs(z)
    across, down = ((x + y) / length + 1) / 2 * (side - 1), ((y - x) / length + 1) / 2 * (side - 1)
    left, top = min(side - 2, math.floor(across)), min(side - 2, math.floor(down))
    return {
        (left + i) + (top + j) * side: (1 - abs(across - left - i)) * (1 - abs(down - top - j))
        for i in (0, 1)
        for j in (0, 1)
    }


def components_value(info, numbers, weights, k):
    """One colour of mean and components that the planes weigh, at weighted directions."""
    count, spans = len(numbers), info["materials"][0]["range"]
    basis = np.reshape(info["basis"], (count + 1, -1, 3))
    if info["colorspace"] == "mrgb":
        channels = {(plane, k) for plane in range(count)}
    else:  # brightness, R - B and G - (R + B) / 2 by turns, then brightness
        triples = info["yccplanes"][1]
        channels = {(3 * turn + each, each) for turn in range(triples) for each in range(3)}
        channels |= {(plane, 0) for plane in range(3 * triples, count)}
    values = [0.0, 0.0, 0.0]
    for place, weight in weights.items():
        for channel in range(3):
            values[channel] += weight * int(basis[0, place, channel]) / 255
        for plane, channel in channels:
            values[channel] += weight * numbers[plane] * (int(basis[plane + 1, place, channel]) - 127) / spans[plane]
    if info["colorspace"] == "mrgb":
        return values[k]
    brightness, red_blue, green = values
    middle = brightness - green / 2
    blue = middle - red_blue / 2
    return (blue + red_blue, green + middle, blue)[k]


def expect_values(path, content, value):
    """A file's picture under LIGHT is that of a slow decoder."""
    path.write_bytes(content)
    shown = open_relightable(path).relight(LIGHT)
    expected = [[[value(r, c, k) for k in range(3)] for c in range(COLUMNS)] for r in range(ROWS)]
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(shown, expected, atol=2e-5)


def expect_whole_files_only(path, content, size, claims):
    """A file that ends anywhere, or that claims another size, is refused. size : as it stands in the heading."""
    for length in range(0, len(content), max(7, len(content) // 150)):
        path.write_bytes(content[:length])
        with pytest.raises(CaptureError) as caught:
            open_relightable(path)
        assert caught.value.problems[0].kind == "relightable-unreadable"
    for claim in claims:
        assert size in content
        path.write_bytes(content.replace(size, claim, 1))
        with pytest.raises(CaptureError):
            open_relightable(path)


def expect_refusal(path, content, text, capsys):
    """A file is refused with this text, in Python and by the command, which ends with status 2 and names it."""
    path.write_bytes(content)
    target = path.parent / "c"
    with pytest.raises(CaptureError, match=text):
        convert(path, target)
    assert not target.exists()
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(path), str(target)])
    assert ended.value.code == 2
    assert path.name in capsys.readouterr().err
