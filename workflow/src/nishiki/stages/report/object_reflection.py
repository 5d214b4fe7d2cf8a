"""Write the sections of an object's page on its texels: parameters as sheets of charts, cost of the residual."""

import numpy as np

from nishiki.atlas.atlas import Atlas
from nishiki.atlas.quality import atlas_picture
from nishiki.atlas.store import ATLAS
from nishiki.brdf.texels.parameters import ParameterMaps, TexelFlag
from nishiki.report.page import Block, Facts, Figure, Figures, Fold, Section, Table
from nishiki.report.pictures import brightened, brightening, colour_picture, scalar_picture, sea
from nishiki.report.scene_page import SceneData
from nishiki.report.svg import bars, figure, percent

LIGHTING = {
    "camera": "a lamp at the camera",
    "direction": "lamps of known direction",
    "position": "lamps at known places",
    "environment": "not stated; an irradiance over the normal was fitted",
}


def model_section(data: SceneData) -> Section:
    """Write parameter maps as sheets of all charts, and the fit's diagnostics."""
    object_brdf = data.inputs["object_brdf"]
    maps, diagnostics = ParameterMaps(object_brdf.folder), object_brdf.diagnostics

    def read(tile: int) -> np.ndarray:
        part = maps.read(tile)
        joined = np.concatenate([part.kd, part.ks, part.sigma[..., None]], axis=-1)
        return np.where((part.flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN))[..., None] == 0, joined, np.nan)

    width = diagnostics["median_sigma"]
    degrees = figure(None if width is None else float(np.degrees(width)))
    highlight, filled, unseen = (
        percent(100 * diagnostics[name]) for name in ("highlight_share", "filled_share", "unseen_share")
    )
    lighting = LIGHTING.get(diagnostics["lighting"], diagnostics["lighting"])
    if aside := diagnostics.get("beside_camera_deg"):
        lighting = f"stated at the camera, found {', '.join(map(figure, aside))}° beside it"
    facts = [
        ("Texels", figure(diagnostics["texels"])),
        ("Lighting", lighting),
        ("Model alone", f"{figure(diagnostics['psnr_db'])} dB over {figure(diagnostics['samples'])} visible samples"),
        ("Highlight observed", f"{highlight} of the texels; median width {degrees}°"),
        (
            "Taken from neighbours",
            f"strength of the highlight at {filled} of the texels, everything at {unseen} that no view shows",
        ),
    ]
    intro = (
        "At every texel: diffuse reflection by Lambert's law, and a highlight by the simplified Torrance-Sparrow "
        "model. The sheets show the charts of the surface beside each other."
    )
    parameters = np.stack([read(tile) for tile in range(maps.tiles)])
    figures = parameter_figures(
        atlas_picture(Atlas.load(data.inputs["texels"].path(ATLAS)), parameters, width=data.widest)
    )
    if len(figures) == 1:
        intro += " No texel has a highlight in this fit, so that there are no sheets of its strength and width."
    return Section("model", "Reflection", [intro, Figures(figures, 3), Facts(facts)])


def parameter_figures(parameters: np.ndarray) -> list[Figure]:
    """Draw K_d, and K_s and sigma where there is any gloss; parameters: sheet (rows, columns, 2 channels + 1)."""
    channels = (parameters.shape[-1] - 1) // 2
    kd, ks = three(parameters[..., :channels]), three(parameters[..., channels : 2 * channels])
    glossy = bool((ks > 0).any())
    figures = []
    for name, values, caption in (
        ("Diffuse reflection", kd, "K_d of every texel: the colour of the surface without its gloss."),
        ("Specular reflection", ks, "K_s of every texel, from its own highlights or its neighbours'."),
    )[: 1 + glossy]:
        gain = brightening(values)
        figures.append(Figure(name, caption + brightened(gain), colour_picture(values * gain)))
    if glossy:
        width = scalar_picture(np.degrees(parameters[..., -1]), sea(), unit="degrees")
        figures.append(Figure("Width of the highlight", "sigma of every texel: the larger, the duller.", width))
    return figures


def three(values: np.ndarray) -> np.ndarray:
    """Select three channels for display: the given ones, one repeated, or the longest, middle and shortest of many."""
    channels = values.shape[-1]
    return values if channels == 3 else values[..., [channels - 1, channels // 2, 0]]


PART_NAMES = {
    "parameters": "reflection parameters",
    "pictures": "captured views as pictures",
    "start_states": "entropy coder's start",
    "index": "index of the tiles",
}
"""Names in words of parts of the residual's file, where they are not those of the code."""
SUMS = ("total", "residual_total")


def residual_section(data: SceneData) -> Section:
    """Write the section on what the model does not explain, and on its bytes."""
    residual = data.diagnostics["residual"]
    intro = "What the model does not explain is kept as wavelet coefficients over the surface and the views."
    if not residual["pictures"]:
        intro += f" {figure(residual['empty_tiles'])} of {figure(residual['tiles'])} tiles need none."
    alone, visible = figure(residual["model_psnr_db"]), percent(100 * residual["kept_of_visible"])
    region = "over the pixels that the texels were solved for, peak: full scale"
    everything = residual["renderer_bytes"]
    others = sum(everything[name] for name in ("mesh", "charts", "cameras", "lamps"))
    facts = [("Model and residual", f"{figure(residual['psnr_db'])} dB {region}; model alone {alone} dB")]
    if pictures := residual["pictures"]:
        equal, size = figure(pictures["equal_bytes_psnr_db"]), figure(pictures["bytes"] / 1000)
        facts.append(("Captured views", f"as pictures, {size} kB, because texels of as many bytes reach {equal} dB"))
    every = percent(100 * residual["kept_of_all"])
    beside = f"of which mesh, charts, cameras and lamps {figure(others / 1000)} kB"
    facts += [
        ("Coefficients kept", f"{figure(residual['kept'])}: {visible} of the visible samples, {every} of all"),
        ("Coded size", f"{figure(residual['bits_per_pixel'])} bit an object pixel"),
        ("All that a renderer needs", f"{figure(everything['total'] / 1000)} kB, {beside}"),
    ]
    parts = data.evaluation.get("bytes", everything)
    short = [name if name in SUMS else name.replace("residual_", "", 1) for name in parts]
    rows = [
        (PART_NAMES.get(name, name.replace("_", " ")), size) for name, size in zip(short, parts.values(), strict=True)
    ]
    largest = sorted((-size, name) for (name, size), part in zip(rows, parts, strict=True) if part not in SUMS)
    svg = bars([-size / 1000 for size, _ in largest], [name for _, name in largest], title="bytes by part", unit="kB")
    drawing = Figure("Where the bytes go", "Everything that a renderer needs.", svg=svg)
    blocks: list[Block] = [intro, Facts(facts), Figures([drawing]), Fold("Bytes", "by part", [Table((), rows, "lr")])]
    return Section("residual", "Residual", blocks)
