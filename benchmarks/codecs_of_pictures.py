"""What a user would otherwise store the photographs as: image codecs view by view, and video codecs over the views.

Each codec takes all views (views, rows, columns, 3) uint8 or uint16, `bits` of which are used, and one quality, and
gives back its bytes and what they decode to. What lies outside the object is not compared: `filled` replaces it by a
smooth continuation, so that no codec pays for an edge that nobody asked for.
"""

import io
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import numpy as np


@dataclass(frozen=True)
class Coded:
    """One encoding of all views: its bytes, the decoded codes in the type of the input, and the seconds of both."""

    bytes: int
    decoded: np.ndarray
    encode_s: float
    decode_s: float


def filled(frames: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Frames whose background continues the object smoothly (inside: (views, rows, columns) bool).

    Pull and push over a pyramid (S. J. Gortler et al., The Lumigraph, SIGGRAPH 1996): what is unknown at one level is
    taken from the next coarser one.
    """
    result = frames.copy()
    for view, mask in enumerate(inside):
        smooth = _pulled(frames[view].astype(np.float32) * mask[..., None], mask.astype(np.float32))
        result[view][~mask] = np.rint(smooth[~mask]).clip(0, np.iinfo(frames.dtype).max)
    return result


def _pulled(colours: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Colours premultiplied by their weight (0..1), to colours everywhere."""
    import cv2

    own = colours / np.maximum(weight, 1e-6)[..., None]
    if min(weight.shape) < 3 or weight.min() > 0.999:
        mean = colours.sum((0, 1)) / max(weight.sum(), 1e-6)
        return np.where(weight[..., None] > 1e-3, own, mean)
    below = _pulled(cv2.pyrDown(colours), cv2.pyrDown(weight))
    rows, columns = weight.shape
    share = np.minimum(weight, 1)[..., None]
    return share * own + (1 - share) * cv2.resize(below.astype(np.float32), (columns, rows))


def per_image(encode, decode, frames: np.ndarray) -> Coded:
    """Encode each view alone."""
    start = perf_counter()
    files = [encode(np.ascontiguousarray(frame)) for frame in frames]
    middle = perf_counter()
    decoded = np.stack([decode(file) for file in files])
    return Coded(sum(map(len, files)), decoded, middle - start, perf_counter() - middle)


def jpeg(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """JPEG (8 bit: deeper codes are shifted down and back); quality: 1-100."""
    import imagecodecs

    shift = max(bits - 8, 0)
    small = np.minimum((frames.astype(np.uint32) + ((1 << shift) >> 1)) >> shift, 255).astype(np.uint8)
    encode = partial(imagecodecs.jpeg8_encode, level=int(quality), subsampling="444", optimize=True)
    coded = per_image(encode, imagecodecs.jpeg8_decode, small)
    return Coded(coded.bytes, coded.decoded.astype(frames.dtype) << shift, coded.encode_s, coded.decode_s)


def jpeg2000(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """JPEG 2000 with the irreversible 9/7 wavelet and the colour transform; quality: PSNR in dB."""
    import imagecodecs

    encode = partial(
        imagecodecs.jpeg2k_encode, level=quality, bitspersample=bits, reversible=False, mct=True, codecformat="j2k"
    )
    return per_image(encode, imagecodecs.jpeg2k_decode, frames)


def jpeg_xl(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """JPEG XL, lossy; quality: Butteraugli distance, smaller is better."""
    import imagecodecs

    shift = 16 - bits if bits > 8 else 0  # it takes the full range of its sample type
    encode = partial(imagecodecs.jpegxl_encode, distance=quality, effort=7, lossless=False)
    coded = per_image(encode, imagecodecs.jpegxl_decode, frames << shift)
    half = (1 << shift) >> 1
    decoded = np.minimum((coded.decoded.astype(np.uint32) + half) >> shift, (1 << bits) - 1).astype(frames.dtype)
    return Coded(coded.bytes, decoded, coded.encode_s, coded.decode_s)


def avif(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """AVIF view by view (AV1 intra pictures, libaom, 4:4:4); quality: 0-100."""
    return per_image(lambda image: _av1(image, bits, quality), _av1_back, frames)


def av1(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """AV1 video over the views in the order of the turn (libaom, 4:4:4, an AVIF sequence); quality: 0-100."""
    start = perf_counter()
    file = _av1(frames, bits, quality)
    middle = perf_counter()
    return Coded(len(file), _av1_back(file), middle - start, perf_counter() - middle)


def _av1(frames: np.ndarray, bits: int, quality: float) -> bytes:
    import imagecodecs

    return imagecodecs.avif_encode(
        frames, level=int(quality), speed=4, bitspersample=bits, pixelformat="444", codec="aom", numthreads=2
    )


def _av1_back(file: bytes) -> np.ndarray:
    import imagecodecs

    return imagecodecs.avif_decode(file)


def hevc(frames: np.ndarray, bits: int, quality: float) -> Coded:
    """HEVC video over the views (x265, 4:4:4, preset slower, tuned for PSNR); quality: constant rate factor."""
    depth = min(max(bits, 8), 12) if bits in (8, 10, 12) else 12
    planes = _to_ycc(frames, bits, depth)
    start = perf_counter()
    file = _x265(planes, depth, quality)
    middle = perf_counter()
    back = _planes_of(file)
    seconds = perf_counter() - middle
    return Coded(len(file), _from_ycc(back, depth, bits, frames), middle - start, seconds)


BT709 = np.array([[0.2126, 0.7152, 0.0722], [-0.11457, -0.38543, 0.5], [0.5, -0.45415, -0.04585]])


def _to_ycc(frames: np.ndarray, bits: int, depth: int) -> np.ndarray:
    """(views, 3, rows, columns) full-range Y'CbCr of BT.709; odd sides are padded to even ones."""
    top, scale = (1 << depth) - 1, ((1 << depth) - 1) / ((1 << bits) - 1)
    ycc = (frames @ BT709.T * scale + np.array([0, 1, 1]) * (1 << (depth - 1))).round().clip(0, top)
    even = np.pad(ycc, ((0, 0), (0, -frames.shape[1] % 2), (0, -frames.shape[2] % 2), (0, 0)), mode="edge")
    return np.moveaxis(even, -1, 1).astype(np.uint8 if depth == 8 else "<u2")


def _from_ycc(planes: np.ndarray, depth: int, bits: int, like: np.ndarray) -> np.ndarray:
    ycc = np.moveaxis(planes, 1, -1)[:, : like.shape[1], : like.shape[2]].astype(np.float64)
    ycc = (ycc - np.array([0, 1, 1]) * (1 << (depth - 1))) * ((1 << bits) - 1) / ((1 << depth) - 1)
    return (ycc @ np.linalg.inv(BT709).T).round().clip(0, (1 << bits) - 1).astype(like.dtype)


def _x265(planes: np.ndarray, depth: int, quality: float) -> bytes:
    import av

    form = "yuv444p" if depth == 8 else f"yuv444p{depth}le"
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as container:
        stream = container.add_stream("libx265", rate=25)
        stream.height, stream.width, stream.pix_fmt = planes.shape[2], planes.shape[3], form
        stream.options = {"crf": str(quality), "preset": "slower", "tune": "psnr", "x265-params": "log-level=none"}
        for picture in planes:
            frame = av.VideoFrame(planes.shape[3], planes.shape[2], form)
            for target, plane in zip(frame.planes, picture, strict=True):
                lines = np.zeros((planes.shape[2], target.line_size), np.uint8)
                row = np.ascontiguousarray(plane).view(np.uint8).reshape(planes.shape[2], -1)
                lines[:, : row.shape[1]] = row
                target.update(lines.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return buffer.getvalue()


def _planes_of(file: bytes) -> np.ndarray:
    import av

    pictures = []
    with av.open(io.BytesIO(file)) as container:
        for frame in container.decode(video=0):
            size = 1 if frame.format.name == "yuv444p" else 2
            rows = [
                np.frombuffer(p, np.uint8).reshape(frame.height, p.line_size)[:, : frame.width * size]
                for p in frame.planes
            ]
            pictures.append([np.ascontiguousarray(r).view("<u2" if size == 2 else np.uint8) for r in rows])
    return np.array(pictures)


# Qualities from coarse to fine: 0.1 to 2 bits per object pixel on photographs.
IMAGE_CODECS = {
    "jpeg": (jpeg, (20, 40, 60, 75, 85, 92)),
    "jpeg2000": (jpeg2000, (30, 33, 36, 39, 42, 45)),
    "jpeg_xl": (jpeg_xl, (8.0, 4.0, 2.0, 1.0, 0.5)),
    "avif": (avif, (30, 45, 60, 70, 80, 88)),
}
VIDEO_CODECS = {
    "av1_video": (av1, (30, 45, 60, 70, 80, 88)),
    "hevc_video": (hevc, (34, 29, 24, 19, 14, 10)),
}
