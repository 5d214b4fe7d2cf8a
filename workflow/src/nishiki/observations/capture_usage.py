"""What ingest reads of a capture, and of how much: files by what they are, bytes, channels, tiles."""

from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path

from nishiki.capture.folder import Capture
from nishiki.capture.seal import payload_files
from nishiki.formats.images import read_header
from nishiki.observations.choice import AnyCapture, chosen

ROLES = {
    "sample": "photographs of the object",
    "check": "photographs under check lights",
    "white": "white boards",
    "dark": "dark frames",
    "ambient": "photographs without lamp",
    "flat": "flat frames",
    "board": "pictures of the calibration board",
}
OTHERS = "tables, spectra, masks"


@dataclass(frozen=True)
class Files:
    """Files of one kind: how many are read, of how many, and their bytes."""

    what: str
    read: int
    of: int
    bytes_read: int
    bytes_of: int


@dataclass(frozen=True)
class CaptureUsage:
    """files: by kind, only kinds that the capture has; channels, tiles: (read, of); tiles: bands of rows times lights
    of a plane, None elsewhere. Bytes are sizes of files: each photograph is read once to be proven against the seal and
    once to be decoded."""

    files: tuple[Files, ...]
    channels: tuple[int, int]
    tiles: tuple[int, int] | None

    @property
    def total(self) -> Files:
        """All kinds together."""
        sums = (sum(getattr(f, name) for f in self.files) for name in ("read", "of", "bytes_read", "bytes_of"))
        return Files("files", *sums)

    def as_dict(self) -> dict:
        """Plain values for JSON."""
        return {**asdict(self), "total": asdict(self.total)}


def usage_of(
    capture: AnyCapture, *, without: Collection[str], channels: str, tile_mib: int, white_block: int = 16
) -> CaptureUsage:
    """What ingest reads with these settings (see `stages/ingest/__init__.py`); no file is decoded but a mask."""
    unopened = chosen(capture, without).files
    stored = len(capture.settings.camera.channels)
    if getattr(capture, "table", None) is not None:
        stored = len(capture.channels)
    kept = stored if channels in ("auto", "all") else 1
    tiles = _tiles(capture, without, kept, tile_mib, white_block) if isinstance(capture, Capture) else None
    return CaptureUsage(_files(capture, unopened), (kept, stored), tiles)


def _files(capture: AnyCapture, unopened: frozenset[str]) -> tuple[Files, ...]:
    kinds = {Path(name).as_posix(): ROLES[f.role] for f in capture.frames for name in f.names}
    kinds |= {Path(f.silhouette).as_posix(): "silhouettes" for f in capture.frames if getattr(f, "silhouette", "")}
    if capture.geometry == "turntable":
        block = capture.settings.turntable
        kinds |= {Path(scan).as_posix(): "range scans" for scan in block.scans}
        kinds |= {Path(block.mesh).as_posix(): "mesh file"} if block.mesh else {}
    counts: dict[str, list[int]] = {what: [0, 0, 0, 0] for what in (*ROLES.values(), "silhouettes")}
    left = {Path(name).as_posix() for name in unopened}
    for path in payload_files(capture.payload):
        name, size = path.relative_to(capture.payload).as_posix(), path.stat().st_size
        entry = counts.setdefault(kinds.get(name, OTHERS), [0, 0, 0, 0])
        for place, value in enumerate((1, size)):
            entry[2 * place + 1] += value
            entry[2 * place] += value if name not in left else 0
    order = sorted(counts.items(), key=lambda item: item[0] == OTHERS)
    return tuple(Files(what, entry[0], entry[1], entry[2], entry[3]) for what, entry in order if entry[1])


def _tiles(
    capture: Capture, without: Collection[str], channels: int, tile_mib: int, white_block: int
) -> tuple[int, int]:
    """Chunks of frames.zarr that hold something of the object, of all that the whole region under every light has."""
    from nishiki.observations.region import object_mask, region_around, region_of, window_of
    from nishiki.observations.tiles import bands_with_object, rows_of_band

    lights = len(chosen(capture, without).capture.observed)
    first = capture.observed[0]
    header = read_header(first.path, name=first.file)
    region = region_of(capture, header.rows, header.columns)
    _, _, rows, columns = region
    every = -(-rows // rows_of_band(lights, rows, columns, channels, tile_mib)) * len(capture.observed)
    if capture.mask is None:
        return every // len(capture.observed) * lights, every
    mask = object_mask(capture, (header.rows, header.columns), region).inside
    around = region_around(mask, region, white_block)
    band_rows = rows_of_band(lights, *around[2:], channels, tile_mib)
    return len(bands_with_object(mask[window_of(region, around)], band_rows)) * lights, every
