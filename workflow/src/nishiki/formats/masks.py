"""Read masks, silhouettes and label pictures: which pixels are the object, and which readings are doubtful.

The cut lies midway between the darkest and the lightest value, so that video range, feathered edges and lossy
compression do not move it. A shape that is painted in the alpha channel counts where the colours have none.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.images import read_codes, read_header
from nishiki.formats.problems import Problem, refuse, warning

SMALL_LABELS = 16  # integers below it number the parts of the object; 16 is black in video range
FEW_COLOURS = 32  # flat colours of a painted label picture; a photograph has more
NEAR = 1 / 16  # of the range of values: JPEG and dithering scatter flat areas by less
FAINT = 1 / 8  # of the lightest value: two values closer than this do not look like black and white
FLAT = 0.98  # share of the visible pixels of one colour, edges of a soft brush left out
EVEN = 0.95  # share of the pixels at either end of the range in a picture of two values
STRAY = 0.01  # share of the pixels of other values that may lie apart from the outline of a smooth edge
THUMBNAIL = 512  # pixels of the longer side on which the outline is judged
HOLE = 0.04  # share of the picture from which one hole looks like an object with its background marked
BITE = 0.15  # the same where the hole is open to one edge, as a bust or a colour chart at the edge is
MAIN = 0.8  # share of the unmarked pixels that the largest part has, where these are one object
BLENDED = 3  # labels without any solid pixel from which a label picture looks blurred


@dataclass(frozen=True)
class Mask:
    """inside: (rows, columns) bool, true on the object; problems: warnings about doubtful readings."""

    inside: np.ndarray
    problems: tuple[Problem, ...]


def read_mask(path: Path, *, name: str | None = None) -> np.ndarray:
    """Read which pixels are the object, (rows, columns) bool."""
    return examine_mask(path, name=name).inside


def examine_mask(path: Path, *, name: str | None = None) -> Mask:
    """Read a mask or silhouette and check for other possible interpretations.

    Parameters
    ----------
    path : Path
        Picture of any format and depth.
    name : str or None
        How to call the file in messages; its own name by default.

    Returns
    -------
    Mask
        Pixels of the object, and warnings: mask-levels (other values than two), mask-colours (several colours),
        mask-alpha (both the colours and the alpha channel have a shape), mask-inverted (the rest of the picture is
        likelier the object).

    Raises
    ------
    CaptureError
        As `read_codes`.
    """
    name = name or path.name
    codes, count = _read_with_alpha(path, name)
    values, problems = _select_values(codes[:, :, :count], codes[:, :, count:], name)
    inside, doubts = _cut_values(values, name)
    problems += doubts
    if looks_inverted(inside):
        share = 100 * inside.mean()
        what = "the mask covers the border of the picture and leaves a part in the middle out: it looks inverted"
        remedy = (
            "If the part that is left out is the object, exchange black and white (ImageMagick: mogrify -negate "
            "MASKS) and convert again; otherwise nothing is wrong"
        )
        problems.append(warning("mask-inverted", name, what, found=f"{share:.1f} % of the pixels", remedy=remedy))
    return Mask(inside, tuple(problems))


def alpha_problems(path: Path) -> list[Problem]:
    """Warn (alpha-unused) where a photograph has a shape in its alpha channel, as one that was cut out has."""
    name = path.name
    if not read_header(path, name=name).alpha:
        return []
    codes, count = _read_with_alpha(path, name)
    alpha = codes[:, :, count:]
    if not alpha.size or alpha.min() == alpha.max():
        return []
    what = "photographs have a shape in their alpha channel, which is not used"
    found = f"{100 * (alpha > 0).mean():.1f} % of this one are not transparent"
    remedy = "To use it as the outline of the object, convert again with --mask: the photographs' own folder for a "
    remedy += "turntable, one of the photographs for a plane"
    return [warning("alpha-unused", name, what, found=found, remedy=remedy)]


def read_labels(path: Path, *, name: str | None = None) -> np.ndarray:
    """Read a label picture, (rows, columns) uint16, from a grey 8- or 16-bit image.

    CaptureError: regions-lossy (JPEG has no exact values), regions-unreadable, those of `read_codes`.
    """
    name = name or path.name
    if read_header(path, name=name).kind == "jpeg":
        what, remedy = "JPEG does not keep the numbers of labels", "Save the labels as PNG from the original picture"
        refuse("regions-lossy", name, what, expected="PNG or TIFF", found="JPEG", remedy=remedy)
    codes, count = _read_with_alpha(path, name)
    grey = codes[:, :, :1]
    if codes.dtype == np.float32 or (codes[:, :, 1:count] != grey).any():
        found, expected = f"{count} channels of {codes.dtype}", "one 8- or 16-bit channel"
        remedy = "Save the numbers of the labels as grey values"
        what = "label image"
        refuse("regions-unreadable", name, what, expected=expected, found=found, remedy=remedy)
    return grey[:, :, 0].astype(np.uint16)


def expect_size(picture: np.ndarray, size: tuple[int, int], name: str, kind: str) -> None:
    """Raise CaptureError (kind and '-size') unless a picture (rows, columns) has the size of the photographs."""
    if picture.shape != size:
        expected, found = f"{size[0]} x {size[1]} as the frames", f"{picture.shape[0]} x {picture.shape[1]}"
        refuse(f"{kind}-size", name, f"size of the {kind}", expected=expected, found=found)


def label_problems(labels: np.ndarray, name: str) -> list[Problem]:
    """Warn (regions-blended) of labels (rows, columns) that occur only on borders between others, with values between.

    Scaling and soft brushes make them: each would become a region of its own.
    """
    import cv2

    present = np.unique(labels)
    square = np.ones((3, 3), np.uint8)
    solid = labels[cv2.erode(labels, square) == cv2.dilate(labels, square)]
    flat = np.unique(solid)
    lost = np.setdiff1d(present, flat)
    between = lost[(lost > flat.min(initial=0)) & (lost < flat.max(initial=0))]
    if len(between) < BLENDED:
        return []
    what = "labels stand only along the borders of others, as in a blurred or scaled picture"
    found = f"{len(between)} of {len(present)} labels, {100 * np.isin(labels, between).mean():.1f} % of the pixels"
    remedy = "Make the label picture without soft edges, and scale it by the nearest neighbour only"
    return [warning("regions-blended", name, what, found=found, remedy=remedy)]


def looks_inverted(inside: np.ndarray) -> bool:
    """Decide whether a mask (rows, columns) bool is the background: one large part is omitted, away from the edges.

    A part that is open to one edge, such as a bust on its table, counts where it is larger.
    """
    import cv2

    step = max(1, max(inside.shape) // THUMBNAIL)
    small = inside[::step, ::step]
    edges = (small[0], small[-1], small[:, 0], small[:, -1])
    corners = bool(small[0, 0] and small[0, -1] and small[-1, 0] and small[-1, -1])
    whole = sum(bool(edge.all()) for edge in edges)
    if small.all() or not corners or whole < 3:
        return False
    _, _, parts, _ = cv2.connectedComponentsWithStats((~small).astype(np.uint8))
    largest, left_out = parts[1:, cv2.CC_STAT_AREA].max(), int((~small).sum())
    return largest >= MAIN * left_out and largest >= (HOLE if whole == 4 else BITE) * small.size


def _read_with_alpha(path: Path, name: str) -> tuple[np.ndarray, int]:
    """Read codes (rows, columns, channels) with alpha, if any, after the colours; count the colour channels."""
    header = read_header(path, name=name)
    count = header.channels - header.alpha
    names = header.names or tuple(f"channel {i}" for i in range(count))
    return read_codes(path, names, header=header, name=name, alpha=True), count


def _select_values(colours: np.ndarray, alpha: np.ndarray, name: str) -> tuple[np.ndarray, list[Problem]]:
    """Select the values (rows, columns) that hold the shape: alpha where only that channel varies, or the colours."""
    values, problems = _grey_values(colours, name)
    if not alpha.shape[2] or alpha.min() == alpha.max():
        return values, problems
    alpha = alpha[:, :, 0]
    visible = alpha > (float(alpha.min()) + float(alpha.max())) / 2
    seen = values[visible].astype(np.float64)
    near = NEAR * max(float(seen.max()) - float(seen.min()), float(np.abs(seen).max()))
    if (np.abs(seen - np.median(seen)) <= near).mean() >= FLAT:
        return alpha, []
    ends = ((seen - seen.min() <= near) | (seen.max() - seen <= near)).mean()
    if ends >= EVEN:
        what = "both the colours and the alpha channel have a shape: transparent pixels are taken for the background"
        problems.append(warning("mask-alpha", name, what, remedy="Flatten the picture if that is wrong"))
        return np.where(visible, values, values[visible].min()), problems
    what = "the colours are those of a photograph: the shape is taken from the alpha channel"
    return alpha, [warning("mask-alpha", name, what, remedy="Save the shape as black and white if that is wrong")]


def _grey_values(colours: np.ndarray, name: str) -> tuple[np.ndarray, list[Problem]]:
    """Reduce to one value per pixel: the strongest channel; of flat colours on black, 1 for every colour."""
    first, *others = np.moveaxis(colours, 2, 0)
    if all(np.array_equal(first, other) for other in others):
        return first, []
    values = colours.max(axis=2)
    flat = _distinct_colours(colours)
    if flat is None or (len(flat) == 2 and not flat[0].any()):
        return values, []
    chroma = flat.max(axis=1).astype(np.float64) - flat.min(axis=1)
    if chroma.max() <= NEAR * float(values.max()):
        return values, []
    found = f"{len(flat)} colours"
    if not flat[0].any():
        what = "the mask has several colours: all of them but black are taken for the object"
        return (values > 0).astype(np.uint8), [warning("mask-colours", name, what, found=found)]
    what = "the mask has colours, none of them black: the lighter ones are taken for the object"
    remedy = "Paint the object white and the background black"
    weighted = colours[:, :, :3].astype(np.float64).mean(axis=2)
    return weighted, [warning("mask-colours", name, what, found=found, remedy=remedy)]


def _distinct_colours(colours: np.ndarray) -> np.ndarray | None:
    """List the colours of a picture (colours, channels), in order; None where flat areas would have fewer."""
    if colours.dtype.kind == "f":
        return None
    step = max(1, max(colours.shape[:2]) // THUMBNAIL)
    for part in (colours[::step, ::step], colours):  # sorting 12 million triples of a photograph takes seconds
        packed = np.zeros(part.shape[:2], np.uint64)
        for channel in range(min(colours.shape[2], 4)):
            packed = packed << np.uint64(16) | part[:, :, channel]
        _, first = np.unique(packed, return_index=True)
        if len(first) > FEW_COLOURS:
            return None
    return colours.reshape(-1, colours.shape[2])[first]


def _cut_values(values: np.ndarray, name: str) -> tuple[np.ndarray, list[Problem]]:
    """Select pixels from the middle of the range up (rows, columns) bool; warn where values other than two occur.

    Small integers are numbers of parts: all but 0 are the object. A picture of one value is all object, or none if 0.
    Smooth edges of a pixel or two move the outline by less than a pixel, and are no reason to warn.
    """
    import cv2

    whole = values.dtype.kind == "u"
    broken = 0 if whole else int((~np.isfinite(values)).sum())
    if broken:
        values = np.where(np.isfinite(values), values, 0)
    if values.dtype.kind == "f":
        levels = np.unique(values).tolist()
    else:
        top = np.iinfo(values.dtype).max + 1
        counts = cv2.calcHist([np.ascontiguousarray(values)], [0], None, [top], [0, top])
        levels = np.flatnonzero(counts).astype(float).tolist()
    low, high = levels[0], levels[-1]
    numbered = whole and low == 0 and high < SMALL_LABELS
    inside = values > 0 if low == high or numbered else values >= (low + high) / 2
    facts = [f"{broken} pixels that are not finite"] if broken else []
    if len(levels) > 2:
        reach = (high - low) / 4
        other = (values != low) & (values != high)
        unsure = ((values > low + reach) & (values < high - reach)).mean()
        square, mask = np.ones((5, 5), np.uint8), inside.astype(np.uint8)
        away = other & (cv2.erode(mask, square) == cv2.dilate(mask, square))  # from the outline by two pixels or more
        if numbered or away.sum() > STRAY * other.sum():
            share = f"{100 * other.mean():.1f} % of the pixels are neither {low:g} nor {high:g}"
            facts.append(f"{len(levels)} values: {share}, {100 * unsure:.1f} % are nearer the middle than to either")
    elif len(levels) == 2 and high - low < FAINT * high:
        facts.append(f"the values {low:g} and {high:g} alone, which look alike")
    elif len(levels) == 1 and 0 < high < (np.iinfo(values.dtype).max if whole else 1):
        facts.append(f"the value {high:g} alone")
    if not facts:
        return inside, []
    cut = "all values but 0 are the object" if numbered or low == high else f"the cut lies at {(low + high) / 2:g}"
    what = f"mask holds other values than black and white; {cut}"
    remedy = "Save masks without soft edges, as PNG, if the outline must be exact"
    return inside, [warning("mask-levels", name, what, found="; ".join(facts), remedy=remedy)]
