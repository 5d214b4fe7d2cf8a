"""Cloth_viewer: a page on which a cloth hangs, lies flat and is dyed under any lamp, data beside it or inside it."""

from pathlib import Path

from nishiki.artifacts.stage import Context
from nishiki.progress import Progress
from nishiki.render.cloth.models import ClothModels
from nishiki.report.viewer.arrays import pack_arrays
from nishiki.report.viewer.page import Blocks, write_page
from nishiki.stages.cloth_render.declaration import MeshSettings
from nishiki.stages.cloth_viewer.scene import material_arrays, shape_of, surfaces, table_numbers

PAGE = Path(__file__).with_name("page.js")


def run(context: Context) -> dict:
    """Write the surfaces, a table of every model, and the page."""
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    about = {**context.stamp, "title": context.inputs["ingest"].diagnostics["capture"]["title"]}
    chosen = {"dyes": context.settings.dyes, "mesh": context.settings.mesh}
    return write_cloth(models, blocks, about, **chosen, progress=context.progress)


def write_cloth(
    models: ClothModels,
    blocks: Blocks,
    about: dict,
    *,
    dyes: dict[str, str],
    mesh: MeshSettings | None = None,
    progress: Progress,
) -> dict:
    """Blocks and page of a cloth; sizes in bytes. about: title and stamp; dyes: sRGB colours (#rrggbb) by name; mesh: a
    further surface, which the page opens with."""
    shapes = {}
    for name, make in surfaces(mesh).items():
        shape = shape_of(make())
        blocks.add(f"shape-{name}", pack_arrays(shape.arrays))
        shapes[name] = shape.numbers
    chosen = [
        (region, model)
        for region in models.regions
        for model in sorted(models.names(region), key=lambda name: name != models.default)
    ]
    for region, model in progress.through(chosen, len(chosen), "model"):
        for part, arrays in material_arrays(models.brdf(region, model)).items():
            blocks.add(f"{part}-{region}-{model}", pack_arrays(arrays))
    manifest = {
        "format": 1, "chain": "cloth", **about, "shapes": shapes, "table": table_numbers(), "dyes": dyes,
        "materials": [{"region": region, "model": model} for region, model in chosen],
    }  # fmt: skip
    return {**write_page(blocks, manifest, PAGE), "shape_bytes": _bytes(blocks, "shape-"), "models": len(chosen)}


def _bytes(blocks: Blocks, prefix: str) -> int:
    return sum(size for name, size in blocks.bytes.items() if name.startswith(prefix))
