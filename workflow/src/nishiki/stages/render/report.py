"""The section of a painting's page with the rendered pictures and films."""

from typing import Any

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents, film
from nishiki.report.numbers import plain
from nishiki.report.page import Figure, Figures, Note, Section
from nishiki.report.pictures import Ruler, file_picture
from nishiki.report.scene_page import text

MOST_PICTURES = 8


def appearance_section(render: Artifact | None, widest: int, video_mb: float, ruler: Ruler | None) -> Section | None:
    """Pictures of at most `widest` pixels across, None without any; ruler : below those seen from the front."""
    if render is None:
        return None
    reported = render.diagnostics.get("pictures") or {}
    items, others, named = [], [], []
    for entry in render.settings["pictures"]:
        data = contents(render, f"{entry['name']}.png")
        if data is None:
            continue
        if len(items) == MOST_PICTURES:
            named.append(f"render/{render.key}/{entry['name']}.png")
            continue
        exposure = (reported.get(entry["name"]) or {}).get("exposure")
        caption = f"{describe(entry)} {exposed(exposure, chosen=entry.get('exposure') == 'auto')}".strip()
        frontal = entry["view"]["kind"] == "frontal"
        picture = file_picture(data, widest)
        items.append(Figure(entry["name"].capitalize(), caption, picture, ruler=ruler if frontal else None))
    for entry in render.settings["sequences"]:
        facts = reported.get(entry["name"]) or {}
        if facts.get("file") in render.manifest["files"]:
            moves = f"The {entry['moves']} goes round at {entry['elevation_deg']:g}° above the plane."
            caption = f"{moves} {exposed(facts.get('exposure'), chosen=True)}".strip()
            shown = film(render, facts["file"], entry["name"].capitalize(), caption, video_mb)
            (items if isinstance(shown, Figure) else others).append(shown)
    if named:
        others.append(f"Also made: {', '.join(named)}.")
    if not items and not others:
        return None
    intro = (
        "Pictures computed from the record, under lights that need not have been there. They show the object as an eye "
        "adapted to the light would see it: white balance by the lamp, exposure by the picture (each caption states "
        "it). The EXR files hold the linear values."
    )
    notes = [Note([note]) for note in render.diagnostics.get("notes") or []]
    return Section("appearance", "Appearance", [intro, Figures(items), *others, *notes])


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
