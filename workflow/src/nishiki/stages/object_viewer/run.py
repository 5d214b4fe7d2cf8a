"""Object_viewer: a page on which the coded object is decoded and seen from any view, data beside it or inside it."""

from pathlib import Path

from nishiki.artifacts.stage import Context
from nishiki.observations.views import Views
from nishiki.render.object.decoded_object import DecodedObject
from nishiki.report.viewer.arrays import pack_arrays
from nishiki.report.viewer.page import Blocks, write_page
from nishiki.stages.object_viewer.scene import decoder_arrays, object_manifest, stream_parts

PAGE = Path(__file__).with_name("page.js")


def run(context: Context) -> dict:
    """Write what a decoder needs and the coded streams, then the page around them."""
    decoded = DecodedObject.open(context.inputs)
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    about = {
        **context.stamp,
        "title": context.inputs["ingest"].diagnostics["capture"]["title"],
        "unit": Views(context.inputs["ingest"].folder).unit,
    }
    return write_object(decoded, blocks, about, without=decoded.numbers(context.settings.hold_out))


def write_object(decoded: DecodedObject, blocks: Blocks, about: dict, *, without: frozenset[int]) -> dict:
    """Blocks and page of an object; sizes in bytes. about: title, stamp, unit; without: views left out of the fit."""
    described = pack_arrays(decoder_arrays(decoded))
    blocks.add("object", described)
    streams, coded_bytes = [], 0
    for part in stream_parts(decoded):
        blocks.add(part.name, part.data)
        streams.append({"name": part.name, "first": part.first, "stop": part.stop})
        coded_bytes += len(part.data)
    manifest = {"format": 1, "chain": "object", **about, "streams": streams}
    sizes = write_page(blocks, manifest | object_manifest(decoded, without=without), PAGE)
    return {
        **sizes,
        "stream_bytes": coded_bytes,
        "decoder_bytes": len(described),
        "coded_object_bytes": decoded.residual.bytes["total"],
    }
