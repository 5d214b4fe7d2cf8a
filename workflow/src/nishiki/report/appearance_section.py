"""The part of the page with the rendered pictures and moving pictures."""

from collections.abc import Callable
from typing import Any

from nishiki.report.numbers import plain
from nishiki.report.pictures import data_uri, file_picture
from nishiki.report.provenance import text

SHOWN = 8
VIDEO_MB = 2.5
VIDEOS = {".mp4": "video/mp4", ".webp": "image/webp", ".png": "image/png"}


def appearance_section(
    settings: dict[str, Any],
    diagnostics: dict[str, Any],
    *,
    read: Callable[[str], bytes | None],
    widest: int,
    folder: str,
) -> dict[str, Any]:
    """Content of the section.

    settings, diagnostics : of the render stage; read : name of one of its files -> bytes, None where it is not there;
    folder : its place below the scene's results, to name what the page does not carry.
    """
    pictures, named = [], []
    for entry in settings["pictures"]:
        file = f"{entry['name']}.png"
        data = read(file)
        if data is None:
            continue
        if len(pictures) < SHOWN:
            picture = file_picture(data, widest)
            exposure = ((diagnostics.get("pictures") or {}).get(entry["name"]) or {}).get("exposure")
            pictures.append(
                {
                    "name": entry["name"],
                    "picture": picture,
                    "caption": f"{describe(entry)} {exposed(exposure, chosen=entry.get('exposure') == 'auto')}".strip(),
                    "frontal": entry["view"]["kind"] == "frontal",
                    "file": file,
                }
            )
        else:
            named.append(f"{folder}/{file}")
    films = []
    for entry in settings["sequences"]:
        found = (diagnostics.get("pictures") or {}).get(entry["name"]) or {}
        file = found.get("file")
        data = read(file) if file else None
        if data is None:
            continue
        kind = next((mime for ending, mime in VIDEOS.items() if file.endswith(ending)), None)
        carried = kind is not None and len(data) <= VIDEO_MB * 1e6
        films.append(
            {
                "name": entry["name"],
                "caption": f"the {entry['moves']} goes round at {entry['elevation_deg']:g}° above the plane. "
                + exposed(found.get("exposure"), chosen=True),
                "source": data_uri(data, kind) if carried else "",
                "video": kind == "video/mp4",
                "file": f"{folder}/{file}",
            }
        )
    return {"pictures": pictures, "films": films, "named": named, "notes": list(diagnostics.get("notes") or [])}


def describe(picture: dict[str, Any]) -> str:
    """Lights and view of a picture in words."""
    lights = [f"{light['illuminant']} from {_place(light)}" for light in picture["lights"]]
    view = picture["view"]
    seen = "seen from the front" if view["kind"] == "frontal" else f"seen from {_place(view)}"
    ambient = f", ambient {text(picture['ambient'])}" if picture["ambient"] else ""
    return f"{' and '.join(lights) or 'no lamp'}{ambient}, {seen}."


def exposed(exposure: float | None, *, chosen: bool) -> str:
    """What a caption says of the exposure; chosen: from the picture itself."""
    if exposure is None:
        return ""
    why = ", chosen from the picture" if chosen else ""
    return f"Exposure {plain(exposure, 2)}{why} (1: a white that faces the lamp is white)."


def _place(direction: dict[str, Any]) -> str:
    return f"{direction['elevation_deg']:g}° above the plane, azimuth {direction['azimuth_deg']:g}°".replace("-", "−")
