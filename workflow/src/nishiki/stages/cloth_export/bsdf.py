"""A cloth's model as a table for renderers that read measured materials, `.bsdf`."""

from nishiki.artifacts.stage import Context
from nishiki.brdf.half_vector_table import HalfVectorTable
from nishiki.formats.bsdf import bsdf_bytes
from nishiki.render.cloth.scene import three
from nishiki.stages.cloth_export.against_model import errors
from nishiki.stages.cloth_export.scene import ExportedCloth


def write(context: Context, cloth: ExportedCloth) -> dict:
    """`cloth.bsdf`; how far its table is from the model."""
    table = HalfVectorTable.of(lambda light, eye: three(cloth.brdf.evaluate(light, eye)))
    described = (
        f"{context.stamp['scene']}, {cloth.region}, {cloth.model}; x weft, y warp; Nishiki {context.stamp['version']}"
    )
    context.output.path("exports/cloth.bsdf").write_bytes(bsdf_bytes(table.arrays(described)))
    return {"files": ["exports/cloth.bsdf"], "against_model": errors(cloth, table)}
