"""Tiny capture folders for tests: valid by default, broken on request."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

RING = [(0.0, 0.0, 1.0), *((0.7 * np.cos(a), 0.7 * np.sin(a), 0.714) for a in np.linspace(0, 2 * np.pi, 5)[:-1])]
CHANNELS = ("red", "green", "blue")


def make_capture(
    folder: Path,
    *,
    lights: list[tuple[float, float, float]] = RING,
    rows: int = 24,
    columns: int = 32,
    channels: tuple[str, ...] = CHANNELS,
    bits: int = 12,
    albedo: float = 0.5,
    checks: int = 1,
    white: bool = True,
    dark: bool = True,
    mask: np.ndarray | None = None,
    exposure_s: float | None = None,
    yaml_extra: dict | None = None,
    seed: int = 1,
) -> Path:
    """Write an unsealed capture of a flat Lambertian plane: light i is named L01, L02 ...; the last `checks` are check.

    Frames are 16-bit PNG (TIFF for more than 4 channels is left to the caller) with 12 significant bits, full scale
    for a white facing the lamp at 80 %, dark level of 100 codes, no noise unless the caller adds it.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    top, level = (1 << bits) - 1, 100 if dark or white else 0
    names = [f"L{i + 1:02d}" for i in range(len(lights))]
    falloff = 0.8 + 0.2 * np.linspace(0, 1, columns)[None, :, None] * np.ones((rows, 1, len(channels)))
    table = ["file,role,light,exposure_s"]
    seconds = "" if exposure_s is None else f"{exposure_s:g}"
    texture = albedo * (0.8 + 0.2 * rng.random((rows, columns, len(channels))))
    for i, (name, light) in enumerate(zip(names, lights, strict=True)):
        cosine = (
            max(float(light[2]), 0.0) / max(float(np.linalg.norm(light)), 1e-9) if np.isfinite(light).all() else 0.5
        )
        lamp = falloff * (1 - 0.01 * i)  # no two lamps are equally strong
        role = "check" if i >= len(lights) - checks else "sample"
        write_frame(folder / f"frames/{name}.png", level + 0.8 * top * cosine * lamp * texture)
        table.append(f"frames/{name}.png,{role},{name},{seconds}")
        if white:
            write_frame(folder / f"white/{name}.png", level + 0.8 * top * cosine * lamp)
            table.append(f"white/{name}.png,white,{name},{seconds}")
    if dark:
        write_frame(folder / "dark/dark.png", np.full((rows, columns, len(channels)), float(level)))
        table.append("dark/dark.png,dark,,")
    (folder / "frames.csv").write_text("\n".join(table) + "\n")
    lines = [f"{n}.png {x:.9g} {y:.9g} {z:.9g}" for n, (x, y, z) in zip(names, lights, strict=True)]
    (folder / "lights.lp").write_text(f"{len(lights)}\n" + "\n".join(lines) + "\n")
    settings = {
        "format": 1,
        "title": "Test plane",
        "geometry": "plane",
        "camera": {"channels": list(channels), "encoding": "linear", "bits": bits, "saturation": 0.98},
        "lights": {"file": "lights.lp", "kind": "direction"},
    }
    if mask is not None:
        cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
        settings["mask"] = "mask.png"
    settings |= yaml_extra or {}
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    return folder


def write_frame(path: Path, values: np.ndarray, dtype: type = np.uint16) -> None:
    """Write values (rows, columns, 1 | 3 channels in RGB order), rounded, as an image of this type."""
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)
    assert cv2.imwrite(str(path), codes[:, :, ::-1] if codes.shape[2] == 3 else codes)


def edit_yaml(folder: Path, **changes) -> None:
    """Set top-level keys of capture.yaml (None removes one)."""
    settings = yaml.safe_load((folder / "capture.yaml").read_text())
    settings.update(changes)
    settings = {k: v for k, v in settings.items() if v is not None}
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))


def edit_text(path: Path, old: str, new: str) -> None:
    """Replace text in a file, which must hold it."""
    text = path.read_text()
    assert old in text, f"{old!r} not in {path}"
    path.write_text(text.replace(old, new))
