"""Compare predicted with photographed light: classes of pixels, colour differences, levels, small pictures of both."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from nishiki.colour.colour import delta_e_2000, srgb_encode, xyz_to_lab, xyz_to_srgb_linear
from nishiki.errors import UserError
from nishiki.evaluate.camera_colour import CameraColour
from nishiki.evaluate.maps import Summary, summarise
from nishiki.threads import over_items

OUTSIDE, DIFFUSE, HIGHLIGHT, SHADOW = 0, 1, 2, 3
NAMES = {DIFFUSE: "diffuse", HIGHLIGHT: "highlight", SHADOW: "shadow"}
HIGHLIGHT_SHARE = 0.1
"""Share of the specular part in all reflected light from which a pixel counts as highlight."""


def classify(diffuse: np.ndarray, specular: np.ndarray, lit: np.ndarray, *, inside: np.ndarray) -> np.ndarray:
    """Classify each pixel, uint8.

    diffuse, specular : (rows, columns) parts of the light that the pixel returns, same unit; lit : (rows, columns)
    share of the lamp that it sees, 0 to 1, in which n.l <= 0 counts as 0; inside : bool. Shadow: less than half lit.
    The parts may be true ones or predicted ones, never those of the photograph: a class that depended on the error to
    be measured would flatter it.
    """
    if not diffuse.shape == specular.shape == lit.shape == inside.shape:
        raise UserError(
            f"classes: expected equal shapes, found {diffuse.shape}, {specular.shape}, {lit.shape} and {inside.shape}"
        )
    classes = np.full(diffuse.shape, DIFFUSE, np.uint8)
    classes[specular > HIGHLIGHT_SHARE * (diffuse + specular)] = HIGHLIGHT
    classes[~(lit >= 0.5)] = SHADOW
    classes[~inside] = OUTSIDE
    return classes


@dataclass(frozen=True)
class ErrorLevel:
    """A level and its largest mean (and 90th percentile, where the scheme has one).

    The schemes of museums and libraries are defined for the patches of a colour target photographed with the object,
    read from the finished file. Here the same thresholds are held against differences of pixels between prediction and
    photograph, which also contain noise and geometry: a level gives the order of the difference, no certificate.
    """

    name: str
    mean: float
    p90: float | None


# FADGI, Technical Guidelines for Digitizing Cultural Heritage Materials, 3rd edition (2023): colour accuracy as mean
# and 90th percentile of Delta E 2000. The limit of one star on the 90th percentile is left open here.
FADGI = (
    ErrorLevel("4 stars", 2.0, 4.0),
    ErrorLevel("3 stars", 3.5, 7.0),
    ErrorLevel("2 stars", 5.0, 10.0),
    ErrorLevel("1 star", 6.5, None),
)
# ISO 19264-1:2021: mean difference of the patches of a target, levels A, B, C. Levels B and C share the mean; they
# differ elsewhere. The standard also limits the largest difference of a patch, which has no counterpart for pixels.
ISO_19264 = (ErrorLevel("A", 4.0, None), ErrorLevel("B", 5.0, None))


def level_of(mean: float | None, p90: float | None, levels: tuple[ErrorLevel, ...]) -> str:
    """Return the best level whose limits hold, or `none`. FADGI requires values below its limits, ISO at most them."""
    if mean is None:
        return "not measured"
    strict = levels is FADGI
    for level in levels:
        within_mean = mean < level.mean if strict else mean <= level.mean
        within_p90 = level.p90 is None or (p90 is not None and p90 < level.p90)
        if within_mean and within_p90:
            return level.name
    return "none"


LARGEST_LEVEL_ERROR = 0.1  # relative, of the light of a part under any lamp, beyond which no level is stated


def stated_levels(parts: list[dict]) -> dict[str, str]:
    """Return the levels of the worst predicted part, `none` where the light of any part is wrong by a tenth.

    parts : `de00` with the mean and 90th percentile of each, and `lights` with their `level_error`.
    """
    worst = max((part["de00"] for part in parts), key=lambda de00: de00["mean"], default={"mean": None, "p90": None})
    errors = [abs(light["level_error"]) for part in parts for light in part["lights"]]
    off = max(errors, default=0) > LARGEST_LEVEL_ERROR
    schemes = {"fadgi": FADGI, "iso_19264": ISO_19264}
    return {name: "none" if off else level_of(worst["mean"], worst["p90"], each) for name, each in schemes.items()}


def error_figures(sums: np.ndarray) -> dict[str, float | None]:
    """Return PSNR, dB, of linear and of coded samples, peak the white, and bias, from sums of `difference_of`.

    None without samples, PSNR also without any difference.
    """
    samples, linear, coded, bias = sums.tolist()
    psnr = [float(10 * np.log10(samples / total)) if samples and total > 0 else None for total in (linear, coded)]
    return {"psnr_linear_db": psnr[0], "psnr_coded_db": psnr[1], "bias": bias / samples if samples else None}


@dataclass
class LightComparison:
    """Comparison of one light band by band; call `score` after the last band."""

    colour: CameraColour  # map to Lab, the same for both images
    de00_map: np.ndarray  # (rows, columns) float32, NaN where not compared
    classes: np.ndarray  # (rows, columns) uint8 of nishiki.evaluate.relighting
    sums: np.ndarray = field(default_factory=lambda: np.zeros((max(NAMES) + 1, 4)))  # of `difference_of`, by class
    excluded: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, shape: tuple[int, int], colour: CameraColour) -> "LightComparison":
        """Return an empty comparison for maps of this shape."""
        return cls(colour, np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8))

    def add(
        self,
        rows: slice,
        predicted: np.ndarray,
        observed: np.ndarray,
        *,
        usable: np.ndarray,
        known: np.ndarray,
        inside: np.ndarray,
        classes: np.ndarray,
    ) -> None:
        """Add one band: predicted, observed (rows, columns, channels) relative to white.

        usable : photograph neither saturated nor dark-clipped there; known : the model has a normal and a colour
        there; inside : pixel of the object; classes : see `classify`. Pixels that are not finite are excluded.
        """
        finite = np.isfinite(predicted).all(axis=-1) & np.isfinite(observed).all(axis=-1)
        used = inside & usable & known & finite
        for reason, count in (
            ("saturated_or_clipped", inside & ~usable),
            ("no_estimate", inside & usable & ~known),
            ("not_finite", inside & usable & known & ~finite),
        ):
            self.excluded[reason] = self.excluded.get(reason, 0) + int(np.count_nonzero(count))
        self.classes[rows] = np.where(used, classes, 0)
        self.sums += difference_of(
            predicted, observed, self.colour.matrix, self.colour.white, self.classes[rows], self.de00_map[rows]
        )

    def score(self) -> dict[str, Any]:
        """Return figures over all bands: errors and CIEDE2000 of all compared pixels and by class; pixels left out."""

        def score_sums(sums: np.ndarray, pixels: np.ndarray) -> dict[str, Any]:
            return {**error_figures(sums), "de00": asdict(summarise(self.de00_map, where=pixels))}

        by_class = {name: score_sums(self.sums[label], self.classes == label) for label, name in NAMES.items()}
        return {
            **score_sums(self.sums.sum(axis=0), self.classes > 0),
            "by_class": by_class,
            "excluded": dict(self.excluded),
        }


def truth_difference(
    xyz: np.ndarray, true_xyz: np.ndarray, white: np.ndarray, *, classes: np.ndarray
) -> tuple[Summary, dict[str, Summary]]:
    """Compute CIEDE2000 between predicted and true XYZ (rows, columns, 3), of all compared pixels and by class.

    white : (3,) XYZ of the perfect white that faces the lamp; classes : (rows, columns), 0 is left out.
    """
    differences = np.full(classes.shape, np.nan, np.float32)
    difference_of(xyz, true_xyz, np.eye(3), white, classes, differences)
    by_class = {name: summarise(differences, where=classes == label) for label, name in NAMES.items()}
    return summarise(differences, where=classes > 0), by_class


def difference_of(
    first: np.ndarray, second: np.ndarray, matrix: np.ndarray, white: np.ndarray, classes: np.ndarray, de00: np.ndarray
) -> np.ndarray:
    """Compute CIEDE2000 of two pictures (rows, columns, C) into de00 where classes is not 0; sum errors (classes, 4).

    matrix : (3, C) from channels to XYZ; white : (3,). The sums are of samples, squared linear differences, squared
    coded differences, and differences. Rows are summed one by one and then in order, so that the result is the same for
    any number of threads.
    """
    sums = np.zeros((len(classes), max(NAMES) + 1, 4))
    first, second = (np.asarray(picture, np.float32) for picture in (first, second))
    at_once = max(PIXELS // classes.shape[1], 1)

    def compare(start: int) -> None:
        rows = slice(start, start + at_once)
        used = classes[rows] > 0
        one, other = (picture[rows][used].astype(np.float64) for picture in (first, second))
        de00[rows][used] = delta_e_2000(*(xyz_to_lab(values @ matrix.T, white) for values in (one, other)))
        difference, coded = one - other, srgb_encode(one) - srgb_encode(other)
        part = sums[rows]
        places = (np.arange(len(part))[:, None] * part.shape[1] + classes[rows])[used]
        for k, values in enumerate((np.ones_like(one), difference**2, coded**2, difference)):
            part[..., k] = np.bincount(places, values.sum(axis=1), part[..., k].size).reshape(part.shape[:2])

    over_items(compare, range(0, len(classes), at_once))
    return sums.sum(axis=0)


PIXELS = 1 << 14  # of two pictures that are compared at a time
COLUMNS = 720
"""Largest width of a preview, pixels."""


class PreviewPair:
    """Builder of two previews, band by band; each pixel is the mean of a square block in linear light."""

    def __init__(self, shape: tuple[int, int], colour: CameraColour, *, columns: int = COLUMNS):
        self.block = -(-shape[1] // columns)
        self.size = tuple(-(-n // self.block) for n in shape)
        self.colour = colour
        self.sums = None
        self.counts = np.zeros(self.size)

    def add(self, rows: slice, predicted: np.ndarray, observed: np.ndarray, *, inside: np.ndarray) -> None:
        """Add predicted, observed : (rows, columns, channels) relative to white; pixels outside the object are omitted.

        Values that are not finite count as 0.
        """
        if self.sums is None:
            self.sums = np.zeros((2, *self.size, predicted.shape[2]))
        down = np.arange(rows.start, rows.start + len(inside)) // self.block
        across = np.arange(inside.shape[1]) // self.block
        places = (down[:, None] * self.size[1] + across)[inside]
        self.counts += np.bincount(places, minlength=self.counts.size).reshape(self.size)
        for sums, picture in zip(self.sums, (predicted, observed), strict=True):
            for channel, values in enumerate(np.where(np.isfinite(picture), picture, 0)[inside].T):
                sums[..., channel] += np.bincount(places, values, self.counts.size).reshape(self.size)

    def arrays(self) -> dict[str, Any]:
        """Return predicted, observed: (rows, columns, 3) float16 linear sRGB, lamp's white at 1, 1, 1; inside: bool."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(self.counts[..., None] > 0, self.sums / self.counts[..., None], 0.0)
        rgb = xyz_to_srgb_linear(self.colour.xyz(means), white=self.colour.white)
        rgb = np.clip(rgb, -60000, 60000).astype(np.float16)
        return {"predicted": rgb[0], "observed": rgb[1], "inside": self.counts > 0}
