"""Tiny capture folders for tests: valid by default, broken on request."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

TITLE = "Test plane"
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
        "title": TITLE,
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


def ring_of_cameras(views: int, *, turn: float = 2 * np.pi, rows: int = 20, columns: int = 24) -> np.ndarray:
    """(views, 3, 4) projection matrices of cameras round the y axis at distance 5 that look at the origin."""
    intrinsics = np.array([[30.0, 0, (columns - 1) / 2], [0, 30.0, (rows - 1) / 2], [0, 0, 1]])
    matrices = []
    for angle in np.arange(views) * turn / views:
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0, -s], [0, -1, 0], [-s, 0, -c]])
        matrices.append(intrinsics @ np.column_stack([rotation, [0, 0, 5.0]]))
    return np.array(matrices)


def turntable_value(view: int, light: int, state: int, rows: int, columns: int) -> np.ndarray:
    """(rows, columns, 3) light of the test object, full scale 1: each photograph differs from all others."""
    y, x = np.mgrid[:rows, :columns]
    base = 0.1 + 0.5 * x / columns + 0.1 * y / rows
    factors = np.array([1.0, 0.8, 0.6]) * (1 - 0.05 * view) * (1 - 0.2 * light) * (1 - 0.3 * state)
    return base[..., None] * factors


def make_turntable(
    folder: Path,
    *,
    views: int = 5,
    states: tuple[str, ...] = ("",),
    lights: tuple[str, ...] = ("",),
    cameras: bool = True,
    silhouettes: bool = True,
    dark: bool = False,
    white: bool = False,
    boards: tuple[str, ...] = (),
    rows: int = 20,
    columns: int = 24,
    bits: int = 12,
    camera: dict | None = None,
    turntable: dict | None = None,
    yaml_extra: dict | None = None,
) -> Path:
    """Write an unsealed turntable capture: views v0, v1 ..., 16-bit PNG with 12 significant bits, dark level 100 codes.

    white: boards without polariser, 0.5 of full scale, one a light; boards: states with a board of their own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    top, level = (1 << bits) - 1, 100 if dark else 0
    table = [("file", "role", "view", "light", "polariser", "silhouette")]
    names = [f"v{i}" if views > 1 else "" for i in range(views)]
    for j, light in enumerate(lights):
        for i, view in enumerate(names):
            for k, state in enumerate(states):
                file = f"frames/{i}_{j}_{k}.png"
                write_frame(folder / file, level + top * turntable_value(i, j, k, rows, columns))
                outline = f"silhouettes/{i}.png" if silhouettes else ""
                table.append((file, "sample", view, light, state, outline))
        if white:
            write_frame(folder / f"white/{j}.png", np.full((rows, columns, 3), level + 0.5 * top))
            table.append((f"white/{j}.png", "white", "", light, "", ""))
        for k, state in enumerate(boards):
            values = level + np.full((rows, columns, 3), 0.6 * top) * [1, 0.9, 0.8] / (k + 1)
            write_frame(folder / f"white/{j}_{k}.png", values)
            table.append((f"white/{j}_{k}.png", "white", "", light, state, ""))
    for i in range(views) if silhouettes else ():
        outline = np.zeros((rows, columns, 1))
        outline[5:15, 6:18] = 255
        write_frame(folder / f"silhouettes/{i}.png", outline, np.uint8)
    if dark:
        write_frame(folder / "dark/dark.png", np.full((rows, columns, 3), float(level)))
        table.append(("dark/dark.png", "dark", "", "", "", ""))
    block = {"full_turn": views > 2, "unit": "mm"}
    if cameras:
        heading = "view," + ",".join(f"p{r}{c}" for r in (1, 2, 3) for c in (1, 2, 3, 4))
        lines = [
            f"{n},{','.join(map(repr, m.ravel().tolist()))}" for n, m in zip(names, ring_of_cameras(views), strict=True)
        ]
        (folder / "cameras.csv").write_text("\n".join([heading, *lines]) + "\n")
        block["cameras"] = "cameras.csv"
    (folder / "frames.csv").write_text("".join(",".join(row) + "\n" for row in table))
    settings = {
        "format": 1,
        "title": "Test object",
        "geometry": "turntable",
        "camera": {"channels": list(CHANNELS), "encoding": "linear", "bits": bits, **(camera or {})},
        "turntable": block | (turntable or {}),
    }
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings | (yaml_extra or {}), sort_keys=False))
    return folder


def edit_block(folder: Path, **changes) -> None:
    """Set keys of the block `turntable` in capture.yaml (None removes one)."""
    block = yaml.safe_load((folder / "capture.yaml").read_text())["turntable"] | changes
    edit_yaml(folder, turntable={k: v for k, v in block.items() if v is not None})
