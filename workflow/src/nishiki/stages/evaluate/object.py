"""Object_evaluate: the decoded object against its photographs, left-out views, truth, and the bytes it takes."""

from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.codec.compact import cost_of
from nishiki.colour.colour import encode
from nishiki.errors import UserError
from nishiki.evaluate.object_photographs import ObjectTruth, Photographs
from nishiki.evaluate.object_quality import (
    COLUMNS,
    DECODED,
    INTERPOLATED,
    MODEL,
    compare,
    comparison,
    figures,
    jpeg2000_psnr,
)
from nishiki.evaluate.tables import planned_truth, write_tables
from nishiki.geometry.mesh import Mesh
from nishiki.render.object.decoded_object import DecodedObject
from nishiki.render.object.shots import ObjectPicture
from nishiki.render.output import write_png


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
    work = Work(context, decoded, cost.mesh.restored(decoded.mesh), photographs, truth, cost.total / max(1, captured))
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
        "rows": [row.as_dict() for row in rows],
        "pictures": work.shown,
    }
    write_tables(context, evaluation, COLUMNS, evaluation["rows"])
    return headlines(evaluation)


class Work:
    """The pictures of one object and their counterparts."""

    def __init__(self, context: Context, decoded: DecodedObject, mesh: Mesh, photographs: Photographs, truth, size):
        self.context, self.decoded, self.settings = context, decoded, context.settings
        self.without = decoded.numbers(self.settings.hold_out)
        options = {"mesh": mesh, "without": self.without}
        self.renderer = decoded.renderer(method=self.settings.interpolation, **options)
        self.model = decoded.renderer(model_only=True, **options)
        self.photographs, self.truth, self.size, self.peers = photographs, truth, size, []  # bytes a picture
        count = len(decoded.views)
        spread = {k * count // max(1, self.settings.pictures) for k in range(min(self.settings.pictures, count))}
        self.to_show = spread | set(sorted(self.without)[: self.settings.pictures])
        self.shown, self.pixels, self.outlined = [], 0, True

    def light(self, light: int) -> list:
        """Return rows of all views under one light."""
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
        """Return rows of one observation; its pictures side by side where they are to be shown."""
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
            pair = jpeg2000_psnr(photograph, inside & valid, self.size), rows[0].judged.psnr_db
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
    """Return the figures that stand in the artifact's diagnostics."""
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
