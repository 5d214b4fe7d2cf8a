"""How large what comes from outside may be: every bound in one table, and how to raise one.

A bound is compared with what a file is or claims before anything of that size is read, decoded or allocated. All are
far above what captures hold. NISHIKI_BOUNDS="name=value,name=value" raises (or lowers) some for one run.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

from nishiki.errors import UserError

VARIABLE = "NISHIKI_BOUNDS"


@dataclass(frozen=True)
class Bound:
    """value: the largest that is read, in `unit`; of: what it is the size of."""

    value: int
    unit: str
    of: str


BOUNDS = MappingProxyType(
    {
        "settings_bytes": Bound(1 << 20, "bytes", "a YAML file: capture.yaml, configuration, settings, calibration"),
        "settings_depth": Bound(32, "levels", "blocks and lists inside each other, in YAML"),
        "settings_values": Bound(100_000, "values", "everything in one YAML file"),
        "scenes_bytes": Bound(1 << 24, "bytes", "a scene table"),
        "manifest_bytes": Bound(1 << 26, "bytes", "the manifest of a sealed capture"),
        "table_bytes": Bound(1 << 24, "bytes", "a table: frames, lights, intensities, cameras, points, spectra"),
        "table_columns": Bound(4096, "columns", "a table"),
        "frames": Bound(20_000, "rows", "frames.csv"),
        "lights": Bound(4096, "lights", "a lights file"),
        "views": Bound(4096, "views", "the cameras of a turntable"),
        "reflectances_bytes": Bound(1 << 28, "bytes", "a table of reflectances"),
        "reflectances_values": Bound(1 << 26, "numbers", "a table of reflectances"),
        "matlab_bytes": Bound(1 << 26, "bytes", "a MATLAB file, and what is unpacked from it"),
        "image_pixels": Bound(1 << 29, "pixels", "a photograph; the largest multi-shot cameras have 400 megapixels"),
        "image_side": Bound(1 << 17, "pixels", "rows or columns of a photograph"),
        "image_bytes": Bound(1 << 32, "bytes", "a photograph as decoded"),
        "image_file_bytes": Bound(1 << 32, "bytes", "a photograph's file"),
        "mesh_bytes": Bound(1 << 32, "bytes", "a file of a mesh or a range scan"),
        "mesh_vertices": Bound(1 << 28, "vertices", "a mesh or a range scan"),
        "mesh_faces": Bound(1 << 29, "faces", "a mesh or a range scan"),
        "folder_entries": Bound(1_000_000, "files and folders", "a capture folder"),
        "folder_depth": Bound(64, "levels", "folders inside each other, in a capture folder"),
        "json_bytes": Bound(1 << 28, "bytes", "a JSON file of an artifact"),
        "store_arrays": Bound(4096, "arrays and groups", "a Zarr store"),
        "store_files": Bound(10_000_000, "files and folders", "a Zarr store"),
        "store_array_bytes": Bound(1 << 42, "bytes", "a Zarr array"),
        "store_chunk_bytes": Bound(1 << 32, "bytes", "a chunk of a Zarr array, unpacked"),
        "store_chunks": Bound(10_000_000, "chunks", "a Zarr array"),
        "arrays_bytes": Bound(1 << 35, "bytes", "the arrays of an .npz file, unpacked"),
        "memory_bytes": Bound(0, "bytes", "what is held at once; 0: three quarters of this machine's memory"),
    }
)


def bound(name: str) -> int:
    """The largest that is read of this kind. UserError where NISHIKI_BOUNDS is not as it should be."""
    value = _raised(os.environ.get(VARIABLE, "")).get(name, BOUNDS[name].value)
    return value or machine_memory() * 3 // 4


@cache
def machine_memory() -> int:
    """Bytes of memory that this process may use: the machine's, or its control group's where that has less."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        with open("/sys/fs/cgroup/memory.max") as file:
            limit = file.read().strip()
    except OSError:
        limit = "max"
    return min(machine, int(limit)) if limit.isdecimal() else machine


@cache
def _raised(text: str) -> dict[str, int]:
    bounds = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in BOUNDS or not value.isdecimal() or not 0 < len(value) <= 18:
            raise UserError(
                f"{VARIABLE}: expected name=number, several apart by commas, found {part[:60]!r}. Names: "
                f"{', '.join(BOUNDS)}"
            )
        bounds[name] = int(value)
    return bounds


def remedy(name: str) -> str:
    """What to do where something trustworthy is larger than a bound."""
    return f"If it is as it should be, raise the bound: {VARIABLE}={name}=..., now {bound(name)} {BOUNDS[name].unit}"
