"""Compare the decoded object with its photographs, held-out views and truth, and count its bytes."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.codec.compact import cost_of
from nishiki.colour.colour import decode, encode
from nishiki.errors import UserError
from nishiki.evaluate.object_photographs import ObjectTruth, Photographs
from nishiki.evaluate.tables import planned_truth, write_tables
from nishiki.geometry.mesh import Mesh
from nishiki.render.display import develop, three_channels, write_png
from nishiki.render.object.pixels import block_mean, extend
from nishiki.render.object.renderer import DecodedObject
from nishiki.render.object.shots import ObjectPicture


def difference(
    coded: np.ndarray, photograph: np.ndarray, outline: np.ndarray, covered: np.ndarray, valid: np.ndarray
) -> dict:
    """Return the difference of pictures over all pixels that either shows.

    psnr_db : peak signal to noise ratio of peak 1; None without pixels or without any difference
    uncovered_pixels, superfluous_pixels : of the outline that the surface misses; that it covers beyond the outline

    Parameters
    ----------
    coded, photograph : (rows, columns, channels) array
        In the capture's encoding, full scale 1.
    outline, covered, valid : (rows, columns) bool array
        Pixels of the object; pixels that the rendered surface reaches; neither dead nor saturated.
    """
    judged = (outline | covered) & valid
    delta = coded[judged].astype(np.float64) - photograph[judged].astype(np.float64)
    squares = np.sum(delta * delta)
    return {
        "psnr_db": float(10 * np.log10(delta.size / squares)) if squares else None,
        "pixels": len(delta),
        "uncovered_pixels": int(np.count_nonzero(judged & ~covered)),
        "superfluous_pixels": int(np.count_nonzero(judged & ~outline)),
    }


def structural_similarity(coded: np.ndarray, photograph: np.ndarray, inside: np.ndarray) -> float | None:
    """Compute the mean structural similarity over the pixels inside; None without pixels.

    Z. Wang et al., Image quality assessment, IEEE Trans. Image Processing 13(4), 2004: Gaussian window of 1.5 pixels,
    mean of the channels, outside of the silhouette counted as equal.
    """
    from scipy.ndimage import gaussian_filter

    if not inside.any():
        return None
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    box = slice(max(rows[0] - 6, 0), rows[-1] + 7), slice(max(columns[0] - 6, 0), columns[-1] + 7)
    mask = inside[box]
    total = 0.0
    for channel in range(coded.shape[2]):
        y = np.where(mask, photograph[box][..., channel], 0).astype(np.float64)
        x = np.where(mask, coded[box][..., channel], 0).astype(np.float64)
        mx, my = (gaussian_filter(v, 1.5, truncate=3.5) for v in (x, y))
        xx, yy, xy = (gaussian_filter(v, 1.5, truncate=3.5) for v in (x * x, y * y, x * y))
        c1, c2 = 0.01**2, 0.03**2
        top = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
        bottom = (mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2)
        total += float(np.mean((top / bottom)[mask]))
    return total / coded.shape[2]


def summary(rows: list[dict]) -> dict:
    """Summarise mean and worst PSNR of the views, and that of all pixels together; None without measurements."""
    values = [row["psnr_db"] for row in rows if row["psnr_db"] is not None]
    squares = sum(row["pixels"] * 10 ** (-row["psnr_db"] / 10) for row in rows if row["psnr_db"] is not None)
    counts = {name: sum(row[name] for row in rows) for name in ("pixels", "uncovered_pixels", "superfluous_pixels")}
    return counts | {
        "views": len(values),
        "mean_psnr_db": float(np.mean(values)) if values else None,
        "worst_psnr_db": min(values, default=None),
        "pooled_psnr_db": float(10 * np.log10(counts["pixels"] / squares)) if squares else None,
    }


DECODED, MODEL, INTERPOLATED = "decoded", "model_alone", "interpolated"
COLUMNS = (
    "view", "light", "left_out", "picture", "against", "psnr_db", "covered_psnr_db", "similarity", "pixels",
    "uncovered_pixels", "superfluous_pixels",
)  # fmt: skip
"""Of a table whose rows compare one picture (a left-out view is INTERPOLATED: from its neighbours' residual) with one
counterpart, against photograph or truth."""


def compare(
    coded: np.ndarray,
    counterpart: np.ndarray,
    *,
    outline: np.ndarray,
    covered: np.ndarray,
    valid: np.ndarray,
    similarity: bool,
    **named,
) -> dict:
    """Compare two pictures over outline and rendered surface together (see `difference`).

    Its figure `covered_psnr_db` is over the pixels of both. named: the other fields of the row.
    """
    both, either = outline & covered, (outline | covered) & valid
    return {
        **named,
        **difference(coded, counterpart, outline, covered, valid),
        "covered_psnr_db": difference(coded, counterpart, both, both, valid)["psnr_db"],
        "similarity": structural_similarity(coded, counterpart, either) if similarity else None,
    }


def figures(rows: Iterable[dict]) -> dict:
    """Summarise by kind of picture: captured views, the model alone, held-out views, and against truth."""
    rows, summaries = list(rows), {}
    for name, picture, left_out, against in (
        ("captured", DECODED, False, "photograph"),
        ("model_alone", MODEL, False, "photograph"),
        ("left_out_interpolated", INTERPOLATED, True, "photograph"),
        ("left_out_model_alone", MODEL, True, "photograph"),
        ("captured_truth", DECODED, False, "truth"),
        ("left_out_interpolated_truth", INTERPOLATED, True, "truth"),
        ("photograph_truth", "photograph", False, "truth"),
    ):
        chosen = [r for r in rows if (r["picture"], r["left_out"], r["against"]) == (picture, left_out, against)]
        if chosen:
            summaries[name] = summary(chosen)
            for figure in ("covered_psnr_db", "similarity"):
                values = [row[figure] for row in chosen if row[figure] is not None]
                summaries[name][f"mean_{figure}"] = float(np.mean(values)) if values else None
    return summaries


CODE_BITS = 12  # of pictures for JPEG 2000
LOWEST_DB, HIGHEST_DB = 15, 80  # of its qualities, in whole dB: PSNR over the whole picture
FILLED_PX = 16  # around the object; beyond, its mean


def jpeg2000_psnr(photograph: np.ndarray, inside: np.ndarray, size: float) -> float | None:
    """Compute the PSNR in dB over the pixels inside of a photograph coded as JPEG 2000 in at most `size` bytes.

    photograph (rows, columns, channels) in the capture's encoding, full scale 1; inside (rows, columns) bool. What lies
    outside continues the object, so that nothing is spent on an edge. None where no quality is as small.
    """
    import imagecodecs

    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    mask, values = inside[box], photograph[box].astype(np.float32)
    filled = np.where(mask[..., None], values, values[mask].mean(axis=0))
    extend(filled, mask, rings=FILLED_PX)
    codes = np.rint(filled.clip(0, 1) * (2**CODE_BITS - 1)).astype(np.uint16)
    low, high, found = LOWEST_DB, HIGHEST_DB, None
    while high - low > 1:
        level = (low + high) // 2
        coded = imagecodecs.jpeg2k_encode(
            codes, level=level, bitspersample=CODE_BITS, reversible=False, codecformat="j2k"
        )
        low, high = (level, high) if len(coded) <= size else (low, level)
        found = coded if len(coded) <= size else found
    if found is None:
        return None
    decoded = imagecodecs.jpeg2k_decode(found).reshape(values.shape) / np.float32(2**CODE_BITS - 1)
    return difference(decoded, values, mask, mask, mask)["psnr_db"]


AMPLIFIED = 10  # times the error as shown


def comparison(
    photograph: np.ndarray, rendered: np.ndarray, model: np.ndarray, inside: np.ndarray, encoding: str, columns: int
) -> dict[str, np.ndarray]:
    """Crop pictures (rows, columns, 3) uint8 to the object, with at most `columns`.

    photograph, rendered and model as seen on a screen, black outside of the silhouette; error: grey plus AMPLIFIED
    times the difference of rendered and photograph. Inputs in the capture's encoding, inside (rows, columns) bool.
    """
    rows, across = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        rows, across = np.arange(inside.shape[0]), np.arange(inside.shape[1])
    box = slice(rows[0], rows[-1] + 1), slice(across[0], across[-1] + 1)
    size = max(1, -(-(box[1].stop - box[1].start) // columns))
    mask = inside[box]
    out = {}
    for name, values in (("photograph", photograph), ("rendered", rendered), ("model", model)):
        linear = np.where(mask[..., None], decode(np.ascontiguousarray(values[box]), encoding), np.float32(0))
        shown = block_mean(linear.astype(np.float32), size)
        out[name] = develop(shown, np.ones(shown.shape[:2], np.float32)).pixels
    delta = three_channels(np.where(mask[..., None], rendered[box] - photograph[box], 0).astype(np.float32))
    grey = 0.5 + AMPLIFIED * block_mean(delta, size)
    out["error"] = np.floor(np.clip(grey, 0, 1) * 255 + 0.5).astype(np.uint8)
    return out


def run(context: Context) -> dict:
    """Render every observation from the coded object, compare it, and count the bytes."""
    settings = context.settings
    photographs = Photographs(context.inputs)
    truth = None
    if path := planned_truth(context):
        if not (path / "truth.zarr").is_dir():
            raise UserError(f"{path}: expected truth.zarr of a simulated turntable capture, found none")
        truth = ObjectTruth(path, photographs)
    decoded = DecodedObject.open(context.inputs)
    charts = decoded.atlas.chart
    cost = cost_of(decoded.mesh, charts, decoded.cameras, decoded.lighting.as_dict(), decoded.residual.bytes)
    captured = len(decoded.lights) * (len(decoded.views) - len(decoded.numbers(settings.hold_out)))
    work = Work(context, decoded, cost.mesh.restore(decoded.mesh), photographs, truth, cost.total / max(1, captured))
    rows = [row for light in range(len(decoded.lights)) for row in work.light(light)]
    summaries = figures(rows)
    bits = 8 * cost.total / work.pixels if work.pixels else None
    evaluation = {
        "encoding": decoded.encoding,
        "peak": 1.0,
        "figures": summaries,
        "jpeg2000": dict(zip(("psnr_db", "decoded_psnr_db"), np.mean(work.peers, axis=0).tolist(), strict=True))
        if work.peers
        else None,
        "left_out": sorted(settings.hold_out),
        "bytes": {**cost.parts, "total": cost.total},
        "object_pixels": work.pixels,
        "bits_per_object_pixel": bits,
        "vertex_shift_px": cost.vertex_shift_px,
        "silhouettes": "known" if work.outlined else "surface",
        "rows": rows,
        "pictures": work.shown,
    }
    write_tables(context, evaluation, COLUMNS, rows)
    return headlines(evaluation)


class Work:
    """The pictures of one object and their counterparts."""

    def __init__(self, context: Context, decoded: DecodedObject, mesh: Mesh, photographs: Photographs, truth, size):
        self.context, self.decoded, self.settings = context, decoded, context.settings
        self.without = decoded.numbers(self.settings.hold_out)
        options = {"mesh": mesh, "without": self.without}
        self.renderer = decoded.renderer(**options)
        self.model = decoded.renderer(model_only=True, **options)
        self.photographs, self.truth, self.size, self.peers = photographs, truth, size, []  # bytes a picture
        count = len(decoded.views)
        spread = {k * count // max(1, self.settings.pictures) for k in range(min(self.settings.pictures, count))}
        self.to_show = spread | set(sorted(self.without)[: self.settings.pictures])
        self.shown, self.pixels, self.outlined = [], 0, True

    def light(self, light: int) -> list:
        """Compare all views under one light."""
        views, shown = range(len(self.decoded.views)), self.renderer
        shots = [(shown.predicted if view in self.without else shown.captured)(view, light=light) for view in views]
        models = self.model.render(self.model.captured(view, light=light) for view in views)
        pictures = self.context.progress.through(shown.render(shots), len(shots), "picture")
        rows = []
        for view, picture, model in zip(views, pictures, models, strict=True):
            label = INTERPOLATED if view in self.without else DECODED
            rows += self.judge(view, light, {label: picture, MODEL: model})
        return rows

    def judge(self, view: int, light: int, made: dict[str, ObjectPicture]) -> list:
        """Compare one observation; return rows, and its pictures side by side where requested."""
        encoding, similarity = self.decoded.encoding, self.settings.similarity
        name = self.decoded.views[view]
        linear, valid = self.photographs.read(view, light)
        outline = self.photographs.silhouette(view)
        covered = made[MODEL].covered
        self.outlined &= outline is not None
        inside = covered if outline is None else outline
        left_out = view in self.without
        self.pixels += 0 if left_out else int(np.count_nonzero(inside))
        photograph = encode(linear, encoding)
        coded = {label: encode(picture.linear, encoding) for label, picture in made.items()}
        named = {"view": name, "light": self.decoded.lights[light], "left_out": left_out, "covered": covered}
        rows = [
            compare(values, photograph, outline=inside, valid=valid, similarity=similarity, picture=label,
                    against="photograph", **named)
            for label, values in coded.items()
        ]  # fmt: skip
        if view in self.to_show and light == 0 and not left_out:
            pair = jpeg2000_psnr(photograph, inside & valid, self.size), rows[0]["psnr_db"]
            self.peers += [pair] if None not in pair else []
        if self.truth is not None and light == 0:
            true = encode(self.truth.read(name), encoding)
            named |= {"outline": self.truth.silhouette(name), "valid": np.ones(inside.shape, bool)}
            rows += [
                compare(values, true, similarity=False, picture=label, against="truth", **named)
                for label, values in {**coded, "photograph": photograph}.items()
                if not (left_out and label == "photograph")
            ]
        if view in self.to_show and light == 0:
            self.show(name, left_out, inside, photograph, coded)
        return rows

    def show(self, name: str, left_out: bool, inside: np.ndarray, photograph: np.ndarray, coded: dict) -> None:
        """Write one picture of photograph, rendering, model alone, ten times the difference; and their arrays."""
        best = coded[INTERPOLATED] if left_out else coded[DECODED]
        panels: dict[str, Any] = comparison(
            photograph, best, coded[MODEL], inside, self.decoded.encoding, self.settings.columns
        )
        stem = f"compare-{name}"
        strip = np.concatenate([panels[key] for key in ("photograph", "rendered", "model", "error")], axis=1)
        write_png(self.context.output.path(f"{stem}.png"), strip, stamp=self.context.stamp)
        np.savez_compressed(self.context.output.path(f"{stem}.npz"), **panels)
        self.shown.append({"view": name, "left_out": left_out, "file": f"{stem}.png", "arrays": f"{stem}.npz"})


def headlines(evaluation: dict) -> dict:
    """Return the figures for the artifact's diagnostics."""
    summaries = evaluation["figures"]
    kept = {
        name: {
            key: part[key]
            for key in ("mean_psnr_db", "worst_psnr_db", "views", "uncovered_pixels", "superfluous_pixels")
        }
        for name, part in summaries.items()
    }
    names = "left_out bytes object_pixels bits_per_object_pixel vertex_shift_px silhouettes jpeg2000".split()
    return {"psnr": kept, **{name: evaluation[name] for name in names}}
