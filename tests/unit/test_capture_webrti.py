"""Folders of webRTIViewer: tiles of coefficients joined, and names that look like angles and are none."""

import cv2
import numpy as np
import pytest
from relightable_images import LIGHT

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.layouts import photographs_in
from nishiki.capture.relightable import open_relightable
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture

ROWS, COLUMNS, TILE, SIDE = 29, 41, 16, 64
SCALE, BIAS = np.array([2.0, 1.5, 1.0, 2.0, 0.5, 1.0]), np.array([149, 151, 68, 77, 80, 0])


def nodes(number=0, top=0, left=0, side=SIDE):
    """Number, place and side of every node, counted from 0, children in reading order."""
    yield number, top, left, side
    if side > TILE:
        for k in range(4):
            half = side // 2
            yield from nodes(4 * number + 1 + k, top + half * (k // 2), left + half * (k % 2), half)


def write_folder(folder, kind, layers, scale, bias, listed=False):
    """Tiles of layers (rows, columns, 3) as PNG, all levels; listed: each node with its box, numbers of its own."""
    folder.mkdir(parents=True)
    above, before = (SIDE - ROWS) // 2, (SIDE - COLUMNS) // 2
    shown = sorted(nodes())
    order = {number: place + 1 for place, (number, *_) in enumerate(shown)}
    if listed:
        order = {number: len(shown) - place for number, place in order.items()}
    lines = [f"{len(shown)} 0", str(TILE), f"{SIDE} {SIDE} 255", "0 0 0"]
    for number, top, left, side in shown:
        low = f"{left / SIDE:g} {(SIDE - top - side) / SIDE:g} 0 {(left + side) / SIDE:g} {(SIDE - top) / SIDE:g} 1"
        children = "-1 -1 -1 -1" if side == TILE else " ".join(str(4 * number + 1 + k) for k in range(4))
        lines += [f"{order[number]} 0 {children} {TILE} 1 {low}"] if listed else []
        if top - above >= ROWS or top + side <= above or left - before >= COLUMNS or left + side <= before:
            continue
        for k, layer in enumerate(layers):
            square = np.zeros((SIDE + 2, SIDE + 2, 3), np.uint8)
            square[1 + above : 1 + above + ROWS, 1 + before : 1 + before + COLUMNS] = layer
            tile = cv2.resize(square[top : top + side + 2, left : left + side + 2], (TILE + 2, TILE + 2))
            cv2.imwrite(str(folder / f"{order[number]}_{k + 1}.png"), tile[..., ::-1])
    text = {"Scale": " ".join(map(str, scale)), "Bias": " ".join(map(str, bias)), "Tree": "\n".join(lines)}
    inner = f'<Size width="{COLUMNS}" height="{ROWS}" coefficients="{len(scale)}"/>'
    inner += "".join(f"<{key}>{text[key]} </{key}>" for key in ("Scale", "Bias"))
    xml = (
        f'<!DOCTYPE Doc>\n<MultiRes format="1">\n<Content type="{kind}">{inner}</Content><Tree>{text["Tree"]}\n</Tree>'
    )
    (folder / "info.xml").write_text(f"{xml}</MultiRes>\n")
    return folder


def example(folder, kind, listed=False):
    """A folder, and the bytes of a file that holds the same."""
    rng = np.random.default_rng(3)
    if kind == "HSH_RTI":
        codes = rng.integers(0, 256, (ROWS, COLUMNS, 3, 9), np.uint8)
        scale, bias = rng.uniform(0.5, 2, 9).astype("<f4"), rng.uniform(-1, 0, 9).astype("<f4")
        write_folder(folder, kind, [codes[..., k] for k in range(9)], bias, scale, listed)  # as the program names them
        head = f"#HSH1.2\n3\n{COLUMNS} {ROWS} 3\n9 2 1\n".encode()
        return head + scale.tobytes() + bias.tobytes() + codes.tobytes()
    codes = rng.integers(0, 256, (ROWS, COLUMNS, 9 if kind == "LRGB_PTM" else 18), np.uint8)
    write_folder(folder, kind, np.split(codes, codes.shape[2] // 3, axis=2), SCALE, BIAS, listed)
    head = "\n".join(
        [
            "PTM_1.2",
            "PTM_FORMAT_" + kind[:-4],
            f"{COLUMNS}",
            f"{ROWS}",
            " ".join(map(str, SCALE)),
            " ".join(map(str, BIAS)),
            "",
        ]
    ).encode()
    below = codes[::-1]
    if kind == "LRGB_PTM":
        return head + np.ascontiguousarray(below[..., :6]).tobytes() + np.ascontiguousarray(below[..., 6:]).tobytes()
    return head + b"".join(np.ascontiguousarray(below[..., colour::3]).tobytes() for colour in range(3))


@pytest.mark.parametrize("kind", ["LRGB_PTM", "RGB_PTM", "HSH_RTI"])
@pytest.mark.parametrize("listed", [False, True], ids=["regular", "listed"])
def test_a_folder_shows_what_the_file_it_was_made_of_shows(tmp_path, kind, listed):
    content = example(tmp_path / "w", kind, listed)
    file = tmp_path / ("x.rti" if kind == "HSH_RTI" else "x.ptm")
    file.write_bytes(content)
    expected = open_relightable(file).relight(np.array(LIGHT))
    np.testing.assert_allclose(open_relightable(tmp_path / "w").relight(np.array(LIGHT)), expected, atol=1e-4)


def test_a_folder_becomes_a_capture_that_keeps_it(tmp_path):
    example(tmp_path / "w", "LRGB_PTM")
    assert photographs_in(tmp_path / "w") == []
    made = convert(tmp_path / "w", tmp_path / "c")
    assert (made.layout.split()[0], made.photographs) == ("rendered", 24)
    assert load_capture(tmp_path / "c").settings.rendered_from == "webrti/info.xml"
    assert not [each for each in check_capture(tmp_path / "c", level="full") if each.severity == "error"]


@pytest.mark.parametrize(
    "change",
    [
        lambda folder, text: text.replace("LRGB_PTM", "IMAGE"),
        lambda folder, text: text.replace('coefficients="6"', 'coefficients="5"'),
        lambda folder, text: text.replace("<Tree>", "<Wood>"),
        lambda folder, text: text.replace(f"\n{TILE}\n", "\n3\n"),
        lambda folder, text: text.replace(f"{SIDE} {SIDE} 255", "1048576 1048576 255"),
        lambda folder, text: text.replace("149", "nan"),
        lambda folder, text: text.replace("Doc>", 'Doc [<!ENTITY a "b">]>'),
        lambda folder, text: (folder / "12_2.png").unlink() or text,
        lambda folder, text: cv2.imwrite(str(folder / "12_2.png"), np.zeros((9, 9, 3), np.uint8)) and text,
    ],
)
def test_folders_that_are_not_read_are_refused_by_name(tmp_path, change):
    example(tmp_path / "w", "LRGB_PTM")
    info = tmp_path / "w/info.xml"
    info.write_text(change(tmp_path / "w", info.read_text()))
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "w", tmp_path / "c")
    assert "w/" in caught.value.problems[0].file
    assert not (tmp_path / "c").exists()


def test_tiles_without_their_heading_are_no_polarisation_series(tmp_path):
    example(tmp_path / "w", "LRGB_PTM")
    (tmp_path / "w/info.xml").unlink()
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "w", tmp_path / "c")
    assert caught.value.problems[0].kind == "layout-unknown"


def states(folder, names, picture):
    folder.mkdir()
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}.png"), picture(i, *map(float, name.split("_"))))


GRID = [f"{g}_{a}" for g in (0, 45, 90, 135) for a in (0, 45, 90)]


def test_photographs_of_a_series_show_one_view_and_vary_with_the_angles(tmp_path):
    rng = np.random.default_rng(0)
    view, noise = rng.integers(40, 120, (24, 24)), rng.integers(-2, 3, (12, 24, 24))
    malus = lambda i, g, a: (view * (1 + np.cos(np.radians(g - a)) ** 2) + noise[i]).astype(np.uint8)  # noqa: E731
    kinds = {}
    for name, picture in {
        "series": malus,
        "still": lambda i, g, a: (view + noise[i]).astype(np.uint8),
        "others": lambda i, g, a: rng.integers(0, 255, (24, 24), np.uint8),
    }.items():
        states(tmp_path / name, GRID, picture)
        try:
            kinds[name] = {each.kind for each in convert(tmp_path / name, tmp_path / f"c{name}").warnings}
        except CaptureError as refused:
            kinds[name] = {each.kind for each in refused.problems}
    assert "states-unexplained" not in kinds["series"]
    assert "states-unexplained" in kinds["still"]
    assert kinds["others"] == {"states-contradicted"}


@pytest.mark.data
def test_a_genuine_folder(data, tmp_path):
    image = open_relightable(data / "foreign" / "webrti")
    assert image.shape == (512, 512)
    pictures = [np.clip(image.relight(np.array(light)), 0, 1) for light in ((0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8))]
    whole = np.concatenate(pictures, axis=2)
    for seam in (whole[255:257], whole[:, 255:257].swapaxes(0, 1)):  # tiles fit together: no edge where they meet
        beside = np.abs(np.diff(whole, axis=0)).mean()
        assert np.abs(seam[0] - seam[1]).mean() < 2 * beside
