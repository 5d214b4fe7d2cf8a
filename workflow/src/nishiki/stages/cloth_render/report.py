"""The section of a cloth's page with the rendered pictures and the film."""

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents, film
from nishiki.report.numbers import figure
from nishiki.report.page import Block, Figure, Figures, Heading, Note, Section
from nishiki.report.pictures import file_picture
from nishiki.stages.cloth_brdf.report import model_name


def rendered_section(render: Artifact | None, widest: int, video_mb: float) -> Section | None:
    """Pictures of at most `widest` pixels across; None where there are none."""
    if render is None:
        return None
    groups: dict[str, list[Figure]] = {"lights": [], "dyes": [], "others": []}
    diagnostics, named = render.diagnostics, []
    for name in diagnostics.get("pictures") or {}:
        data = contents(render, f"{name}.png")
        if data is not None:
            group, heading, caption = words(name)
            groups[group].append(Figure(heading, caption, file_picture(data, widest)))
    video = diagnostics.get("video") or {}
    if video.get("file") in render.manifest["files"]:
        moving = film(render, video["file"], "The film", f"{figure(video['frames'])} frames.", video_mb)
        (groups["others"] if isinstance(moving, Figure) else named).append(moving)
    if not any(groups.values()) and not named:
        return None
    model = ", ".join(filter(None, (model_name(diagnostics.get("model", "")), diagnostics.get("region"))))
    from_file = (diagnostics.get("surface") or {}).get("kind") == "file"
    shown = (
        "A surface from a file, covered with the cloth" if from_file else "A square of the cloth that fell over a ball"
    )
    blocks: list[Block] = [
        f"{shown}; its weft is followed over every fold, and what each point sends to the eye is computed with the "
        f"fitted reflection (model: {model})."
    ]
    lights, dyes = len(groups["lights"]) - 1, len(groups["dyes"])
    if groups["lights"]:
        heading = Heading(f"From {lights} light{'s' * (lights > 1)}", "in the cloth's own colour")
        blocks += [heading, Figures(groups["lights"], 3)]
    if groups["dyes"]:
        blocks += [Heading(f"In {dyes} dye{'s' * (dyes > 1)}", "the same gloss over each"), Figures(groups["dyes"], 3)]
    if groups["others"]:
        blocks.append(Figures(groups["others"]))
    notes = [Note([note]) for note in diagnostics.get("notes") or []]
    return Section("rendered", "The cloth", [*blocks, *named, *notes])


def words(name: str) -> tuple[str, str, str]:
    """Group, heading and caption of a picture."""
    if name.startswith("drape-dye-"):
        return "dyes", name.removeprefix("drape-dye-").capitalize(), ""
    if name.startswith("drape-light-"):
        return "lights", f"Light {name.removeprefix('drape-light-')} alone", ""
    if name == "drape":
        return "lights", "All lights", ""
    if name == "cylinders":
        return "others", "On cylinders", "the warp upright, oblique, and around."
    return "others", name.replace("-", " ").capitalize(), ""
