"""Pictures that grow by bands of rows on the disk, and their JPEG files: one a picture, or the tiles of a deep zoom.

Two layouts of a deep zoom: Microsoft's as OpenLIME reads it (`NAME.dzi`, `NAME_files/LEVEL/COLUMN_ROW.jpg`; level 0 is
the largest that fits into one tile, not a single pixel), and that of IIIF's Image API 3.0 at level 0 (`info.json`,
`REGION/SIZE/0/default.jpg`).
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

TILE, OVERLAP = 254, 1
IIIF_TILE, IIIF_WHOLE = 512, 1024  # tiles without overlap; longest side of the whole picture in one file
ROWS_AT_A_TIME = 512  # in memory
Samples = np.ndarray  # (rows, columns, 3) uint8, R, G, B; may lie on the disk


def picture_on_disk(path: Path, rows: int, columns: int) -> Samples:
    """Make an empty picture in a file, written and read by bands."""
    return np.memmap(path, np.uint8, "w+", shape=(rows, columns, 3))


def write_jpeg(path: Path, picture: Samples, quality: int) -> None:
    """One JPEG file with full resolution of all three channels."""
    path.write_bytes(jpeg_bytes(picture, quality))


def jpeg_bytes(picture: Samples, quality: int) -> bytes:
    """Encode a JPEG with full resolution of all three channels, which may be no colours; Huffman codes of its own."""
    import cv2

    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, quality),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        *(cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    ]
    return cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)[1].tobytes()


def png_bytes(picture: Samples) -> bytes:
    """Encode a PNG of 8 bits: red, green, blue, and alpha where there is a fourth sample."""
    import cv2

    order = [2, 1, 0, 3][: picture.shape[2]]
    return cv2.imencode(".png", np.ascontiguousarray(picture[..., order]))[1].tobytes()


def read_jpeg(path: Path) -> Samples:
    """Read the samples of a JPEG file."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"{path}: not a picture")
    return np.ascontiguousarray(picture[..., ::-1])


def write_deep_zoom(folder: Path, name: str, picture: Samples, scratch: Path, quality: int) -> None:
    """Tiles of all levels, the first a single tile, the last at full resolution. scratch: for smaller copies."""
    rows, columns = picture.shape[:2]
    levels = (-(-max(rows, columns) // TILE) - 1).bit_length()
    (folder / f"{name}.dzi").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{OVERLAP}" '
        f'TileSize="{TILE}"><Size Width="{columns}" Height="{rows}"/></Image>\n'
    )
    present = picture
    for level in range(levels, -1, -1):
        here = folder / f"{name}_files" / str(level)
        here.mkdir(parents=True)
        for row, column, window in _tiles(*present.shape[:2]):
            (here / f"{column}_{row}.jpg").write_bytes(jpeg_bytes(present[window], quality))
        if level:
            present = _halved(present, scratch / f"{name}_{level - 1}")


def write_iiif_image(folder: Path, address: str, picture: Samples, scratch: Path, quality: int) -> None:
    """Tiles of all levels at full, half, quarter ... size, as a server of the Image API 3.0 would name them.

    address: of the folder on the web, which info.json must state. scratch: for smaller copies. The whole picture is
    there in two sizes, that of the last tile and `iiif_size`; more of it has to be put together from tiles.
    """
    import cv2

    rows, columns = picture.shape[:2]
    factors, present = [1], picture
    width, height = iiif_size(rows, columns)
    while True:
        factor = factors[-1]
        high, wide = present.shape[:2]
        for top in range(0, high, IIIF_TILE):
            for left in range(0, wide, IIIF_TILE):
                tile = present[top : top + IIIF_TILE, left : left + IIIF_TILE]
                x, y = left * factor, top * factor
                region = f"{x},{y},{min(IIIF_TILE * factor, columns - x)},{min(IIIF_TILE * factor, rows - y)}"
                _iiif_file(folder, region, f"{tile.shape[1]},{tile.shape[0]}").write_bytes(jpeg_bytes(tile, quality))
        if width <= wide < 2 * width:
            whole = cv2.resize(np.asarray(present), (width, height), interpolation=cv2.INTER_AREA)
        if max(high, wide) <= IIIF_TILE:
            break
        factors.append(2 * factor)
        present = _halved(present, scratch / f"factor_{2 * factor}")
    wholes = {present.shape[1::-1]: present, (width, height): whole}  # viewers ask for both
    for (wide, high), shown in wholes.items():
        _iiif_file(folder, "full", f"{wide},{high}").write_bytes(jpeg_bytes(shown, quality))
    _iiif_file(folder, "full", "max").write_bytes(jpeg_bytes(whole, quality))
    info = {
        "@context": "http://iiif.io/api/image/3/context.json", "id": address, "type": "ImageService3",
        "protocol": "http://iiif.io/api/image", "profile": "level0", "width": columns, "height": rows,
        "maxWidth": IIIF_WHOLE, "sizes": [{"width": wide, "height": high} for wide, high in wholes],
        "tiles": [{"width": IIIF_TILE, "scaleFactors": factors}],
    }  # fmt: skip
    (folder / "info.json").write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")


def read_iiif_tiles(folder: Path, rows: int, columns: int) -> Iterator[tuple[tuple[slice, slice], Samples]]:
    """Tiles of `write_iiif_image` at full resolution with their windows, decoded."""
    for top in range(0, rows, IIIF_TILE):
        for left in range(0, columns, IIIF_TILE):
            high, wide = min(IIIF_TILE, rows - top), min(IIIF_TILE, columns - left)
            path = folder / f"{left},{top},{wide},{high}" / f"{wide},{high}" / "0" / "default.jpg"
            yield (slice(top, top + high), slice(left, left + wide)), read_jpeg(path)


def iiif_size(rows: int, columns: int) -> tuple[int, int]:
    """Width and height of the larger whole picture that `write_iiif_image` keeps: at most IIIF_WHOLE pixels a side."""
    share = min(1.0, IIIF_WHOLE / max(rows, columns))
    return max(1, round(columns * share)), max(1, round(rows * share))


def _iiif_file(folder: Path, region: str, size: str) -> Path:
    here = folder / region / size / "0"
    here.mkdir(parents=True, exist_ok=True)
    return here / "default.jpg"


def read_full_resolution(folder: Path, name: str, rows: int, columns: int) -> Iterator[tuple[slice, Samples]]:
    """Bands of the last level of a deep zoom, a row of tiles each, decoded."""
    level = max(int(path.name) for path in (folder / f"{name}_files").iterdir())
    band = np.empty((0, columns, 3), np.uint8)
    for row, column, window in _tiles(rows, columns):
        tile = read_jpeg(folder / f"{name}_files/{level}/{column}_{row}.jpg")
        top, left = row * TILE, column * TILE
        high, wide = min(TILE, rows - top), min(TILE, columns - left)
        if column == 0:
            band = np.empty((high, columns, 3), np.uint8)
        inner = tile[top - window[0].start :, left - window[1].start :][:high, :wide]
        band[:, left : left + wide] = inner
        if left + wide == columns:
            yield slice(top, top + high), band


def _tiles(rows: int, columns: int) -> Iterator[tuple[int, int, tuple[slice, slice]]]:
    """Row and column of every tile, and its window with the overlap."""
    for row in range(-(-rows // TILE)):
        for column in range(-(-columns // TILE)):
            yield row, column, (_window(row, rows), _window(column, columns))


def _window(number: int, size: int) -> slice:
    return slice(max(number * TILE - OVERLAP, 0), min((number + 1) * TILE + OVERLAP, size))


def _halved(picture: Samples, path: Path) -> Samples:
    """Return half the size, rounded up: means of squares of four."""
    import cv2

    rows, columns = picture.shape[:2]
    half = picture_on_disk(path, -(-rows // 2), -(-columns // 2))
    for top in range(0, rows, ROWS_AT_A_TIME):
        band = np.asarray(picture[top : top + ROWS_AT_A_TIME])
        band = cv2.copyMakeBorder(band, 0, len(band) % 2, 0, columns % 2, cv2.BORDER_REPLICATE)
        means = cv2.resize(band, (band.shape[1] // 2, len(band) // 2), interpolation=cv2.INTER_AREA)
        half[top // 2 : top // 2 + len(means)] = means
    return half
