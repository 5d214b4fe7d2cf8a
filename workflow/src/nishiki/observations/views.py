"""Read the views of an object: linear light of one photograph at a time, with unusable values marked."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from nishiki.colour.colour import decode, encode
from nishiki.errors import UserError
from nishiki.formats.stored import open_made_by, understood
from nishiki.observations.linearise import StoredArrays, picture_edges

__all__ = ["Views", "decode", "encode"]
STORE, FORMAT = "views.zarr", 1  # name and version of the file; readers refuse others


class Views(StoredArrays):
    """The ingested views of one capture, opened for reading; one photograph is in memory at a time.

    views: names in the order of the turn; lights, states: names, ('',) where there is but one without a name; shape
    (rows, columns); channels: names; encoding: 'linear' | 'srgb', of the photographs; full_turn: the last view
    neighbours the first; unit: of the world's coordinates, unit_mm: in millimetres, or None; lamp: {"kind": "camera" |
    "direction" | "position_mm" | "unknown", "vectors": (lights, 3) float64 in the camera's frame (x right, y up, z
    towards the camera) or None}; matrices: (3, 4) float64 by view, or None; intrinsics: {"matrix", "distortion"} or
    None; board: description of the calibration board, or None; geometry: files of the object's geometry in this
    artifact; attributes: everything stored.
    """

    def __init__(self, folder: Path | str):
        """Open `views.zarr`, or the folder that holds it. UserError where it is none."""
        path = Path(folder)
        path = path if path.name.endswith(".zarr") else path / STORE
        group, stored = open_made_by("ingest", path, "ingested views", FORMAT)
        self.path, self._group, self.attributes = path, group, stored
        with understood(path):
            self.dtype = np.dtype(group["codes"].dtype)
            self.views: tuple[str, ...] = tuple(stored["views"])
            self.lights: tuple[str, ...] = tuple(stored["lights"])
            self.states: tuple[str, ...] = tuple(stored["states"])
            self.channels: tuple[str, ...] = tuple(stored["channels"])
            self.shape: tuple[int, int] = tuple(stored["shape"])
            self.encoding: str = stored["encoding"]
            self.full_turn: bool = stored["full_turn"]
            self.unit: str = stored["unit"]
            self.unit_mm: float | None = stored["unit_mm"]
            self.board_description: dict | None = stored["board"]
            self.intrinsics: dict | None = stored["intrinsics"]
            self.geometry: dict = stored["geometry"]
            lamp, matrices = stored["lamp"], stored["matrices"]
            self.lamp = {**lamp, "vectors": None if lamp["vectors"] is None else np.array(lamp["vectors"], np.float64)}
            self.matrices = None if matrices is None else {view: np.array(m) for view, m in matrices.items()}

    def index(self, view: str | int, *, state: str | None = None, light: str | None = None) -> int:
        """Return the number of a stored frame; state, light: None for the first. UserError for unknown names."""
        place = self._place(self.lights, light, "light") * len(self.views)
        place = (place + self._view(view)) * len(self.states)
        return place + self._place(self.states, state, "polariser state")

    def read(
        self, view: str | int, *, state: str | None = None, light: str | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Read linear values (rows, columns, channels) float32 and validity (rows, columns) bool of one photograph.

        view: name or number; state, light: None for the first. 1 is a perfect white where a board was photographed
        without polariser, else full scale at the longest exposure time. Valid: finite, no defect, gain known, saturated
        in no channel; code 0 is a valid measurement. A saturated sample keeps its value; what cannot be formed is 0.
        """
        from nishiki.observations.kernels import ANY_CODE, decode_codes  # cameras alone need no compiled code

        frame = self.index(view, state=state, light=light)
        codes = self.codes(view, state=state, light=light)
        gain = self.gain[frame // (len(self.views) * len(self.states))] * np.float32(self.attributes["scale"][frame])
        fields = gain[None], self.dark[frame if len(self.dark) > 1 else 0][None], self._usable
        edges = picture_edges(self.shape, self.attributes["white_block"])
        code = self.attributes["saturation_code"]
        limit = self.dtype.type(code) if self.dtype.kind == "u" else np.float32(np.inf if code is None else code)
        (values,), (valid,) = decode_codes(codes[None], (self.lut, limit, ANY_CODE), fields, edges)
        return values, valid

    def codes(self, view: str | int, *, state: str | None = None, light: str | None = None) -> np.ndarray:
        """Read stored codes (rows, columns, channels) of one photograph, in the camera's own type."""
        return self._group["codes"][self.index(view, state=state, light=light)]

    def find_saturated(self, view: str | int, *, state: str | None = None, light: str | None = None) -> np.ndarray:
        """Find the values (rows, columns, channels) bool of one photograph that are saturated, without defects."""
        code = self.attributes["saturation_code"]
        if code is None:
            return np.zeros((*self.shape, len(self.channels)), bool)
        return (self.codes(view, state=state, light=light) >= code) & (self._usable != 0)[..., None]

    def board(self, state: str, *, light: str | None = None) -> np.ndarray | None:
        """Return the mean white board (rows, columns, channels) float32 of a state, in the units of `read`; or None."""
        key = [self.lights[self._place(self.lights, light, "light")], state]
        boards = self.attributes["boards"]
        return self._group["boards"][boards.index(key)] if key in boards else None

    def mean_light(self, view: str | int) -> np.ndarray:
        """Compute the mean (rows, columns, channels) float32 over the lights, in the state without polariser if any."""
        state = "off" if "off" in self.states else self.states[0]
        photographs = (self.read(view, state=state, light=light)[0] for light in self.lights)
        total = sum(photograph.astype(np.float64) for photograph in photographs)
        return (np.asarray(total) / len(self.lights)).astype(np.float32)

    def silhouette(self, view: str | int) -> np.ndarray | None:
        """Return the capture's silhouette (rows, columns) bool, or None."""
        place = self._view(view)
        if self.views[place] not in self.attributes["silhouettes"]:
            return None
        return self._group["silhouettes"][place][..., 0] != 0

    def board_pictures(self) -> Iterator[tuple[dict, np.ndarray]]:
        """Yield each picture of the calibration board: its `name` and `view` (or None), and (rows, columns) uint8 grey.

        Their names stand in `attributes["calibration"]`.
        """
        for place, named in enumerate(self.attributes["calibration"]):
            yield named, self._group["calibration"][place][..., 0]

    def _view(self, view: str | int) -> int:
        if isinstance(view, str):
            return self._place(self.views, view, "view")
        if not 0 <= view < len(self.views):
            raise UserError(f"{self.path}: no view number {view}; there are {len(self.views)}")
        return int(view)

    def _place(self, names: tuple[str, ...], name: str | None, kind: str) -> int:
        if name is None:
            return 0
        if name not in names:
            raise UserError(f"{self.path}: no {kind} {name!r}; there are: {', '.join(map(repr, names[:50]))}")
        return names.index(name)

    @cached_property
    def _usable(self) -> np.ndarray:
        return np.ones(self.shape, np.uint8) if self.defect is None else (~self.defect).astype(np.uint8)


def largest_value(views: Views) -> float | None:
    """Compute the linear value at which this capture's photographs saturate; None for floating-point frames."""
    if views.dtype.kind != "u":
        return None
    return float(views.lut[views.attributes["saturation_code"]] * views.gain.max() * max(views.attributes["scale"]))
