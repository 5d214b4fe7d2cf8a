"""Separate: per pixel, the lights under which it shows diffuse reflection only."""

import numpy as np

from nishiki.artifacts.maps import MapWriter, TiledStage
from nishiki.artifacts.stage import Context
from nishiki.model_selection.decision import economy
from nishiki.model_selection.lights import choose_lights
from nishiki.observations.plane import Observations, parcels
from nishiki.photometric.light_selection import pack_lights, select_diffuse
from nishiki.stages.separate import OUTPUTS


def map_tiles(context: Context) -> dict:
    """Select the lights band by band; usable lights are kept as one bit each."""
    frames = Observations(context.inputs["ingest"].folder)
    lights = frames.fit_lights(context.settings.hold_out)
    rows_used, decision = choose_lights(frames, lights, context.settings)
    lights = lights[rows_used]
    if decision:
        context.progress.tell(str(decision))
    rows, columns = frames.shape
    maps = MapWriter.of(context, OUTPUTS, frames.shape, frames.band_rows)
    maps.group.update(lights=[frames.lights[j] for j in lights])
    usable = maps.create("usable", (-(-len(lights) // 8),))
    highlights, shadows = maps.create("highlights"), maps.create("shadows")
    settings = context.settings

    def select_band(band: slice) -> np.ndarray:
        size = band.stop - band.start, columns
        packed = np.empty((*size, -(-len(lights) // 8)), np.uint8)
        counts = np.empty((2, *size), np.uint16)

        def choose(rows: slice, observations: np.ndarray, valid: np.ndarray) -> list[int]:
            strip = slice(rows.start - band.start, rows.stop - band.start)
            chosen, counted = np.empty_like(valid), counts[:, strip]
            for parcel in parcels(frames, rows, lights):
                area = np.s_[:, parcel.rows, parcel.columns]
                selection = select_diffuse(
                    parcel.scale_to_centre(observations[area]),
                    parcel.directions,
                    valid=valid[area],
                    method=settings.method,
                    w1=settings.w1,
                    w2=settings.w2,
                    keep=settings.keep,
                )
                chosen[area] = selection.usable
                counted[area] = selection.highlights, selection.shadows
            packed[strip] = pack_lights(chosen)
            return [np.count_nonzero(chosen), *(a.sum(dtype=np.int64) for a in counted), np.count_nonzero(valid)]

        found = list(frames.strips(band, lights=lights, channel="mean", work=choose))
        usable[band], highlights[band], shadows[band] = packed, *counts
        return np.sum(found, axis=0)

    totals = sum(map(select_band, context.progress.over(context.share(frames.bands()), "band")), np.zeros(4, np.int64))
    same = {"lights": [frames.lights[j] for j in lights], "economy": economy(decision)}
    return {"same": same, "samples": rows * columns * len(lights), "totals": totals.tolist()}


def merge(context: Context, tallies: list[dict]) -> dict:
    """Compute fractions of all samples."""
    totals = np.sum([tally["totals"] for tally in tallies], axis=0)
    names = ("usable", "highlight", "shadow", "valid")
    fractions = {f"{name}_fraction": float(n / tallies[0]["samples"]) for name, n in zip(names, totals, strict=True)}
    return {**tallies[0]["same"], **fractions}


run = TiledStage(map_tiles, merge)
