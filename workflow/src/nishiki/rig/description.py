"""Read the description of a rig in YAML, list the ports of this computer, and open the devices."""

import glob
import importlib.util
import math
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from nishiki.artifacts.declaration import Closed, parse
from nishiki.capture.schema import UnquotedStatesLoader, read_mapping
from nishiki.errors import UserError
from nishiki.formats.problems import CaptureError
from nishiki.installation import is_installed, optional
from nishiki.rig.axes import ComXimSettings, ComXimTurntable, Grbl, GrblAxis, GrblSettings
from nishiki.rig.cameras import FolderSettings, GPhotoCamera, GPhotoSettings, WatchedFolder, run_command
from nishiki.rig.described import (
    BracketDome,
    DescribedAxis,
    DescribedLamps,
    DescribedPolariser,
    DomeSettings,
    HomeMadeAxis,
    HomeMadeLamps,
    HomeMadePolariser,
    State,
)
from nishiki.rig.device import Exposure, PromptedPolariser, Rig, closed_on_failure
from nishiki.rig.frames_table import PlannedFrame


class PythonDevice(Closed):
    """Device driven by a class in a Python file, with the methods of `nishiki.rig.device`."""

    kind: Literal["python"]
    file: str = Field(description="Python file, relative to the description")
    name: str = Field(description="name of the class")
    options: dict[str, Any] = Field({}, description="passed to the class by name")


class DeviceFile(Closed):
    """A home-made device on a serial line, described in a YAML file of its own."""

    kind: Literal["described"]
    file: str = Field(description="YAML file of the device, relative to the description")
    port: str | None = Field(None, description="serial port, in place of the file's")


class PromptSettings(Closed):
    """Polariser turned by a person."""

    kind: Literal["prompt"]
    states: tuple[State, ...] = Field(("off", "on"), min_length=1, description="its states, named as in frames.csv")


CameraSettings = Annotated[GPhotoSettings | FolderSettings | PythonDevice, Field(discriminator="kind")]
LampSettings = Annotated[DomeSettings | DeviceFile | PythonDevice, Field(discriminator="kind")]
AxisSettings = Annotated[GrblSettings | ComXimSettings | DeviceFile | PythonDevice, Field(discriminator="kind")]
PolariserSettings = Annotated[PromptSettings | DeviceFile | PythonDevice, Field(discriminator="kind")]


class RigDescription(Closed):
    """rig.yaml."""

    camera: CameraSettings = Field(description="the camera")
    lamps: LampSettings | None = Field(None, description="lamps that this computer switches")
    axes: dict[str, AxisSettings] = Field({}, description="axes by name: turntable, of a goniometer, of a stage")
    polarisers: dict[str, PolariserSettings] = Field({}, description="polarisers by name")

    @model_validator(mode="after")
    def _release_of_a_dome(self) -> "RigDescription":
        if getattr(self.camera, "release", None) == "lamps" and not isinstance(self.lamps, DomeSettings):
            raise ValueError("release: lamps needs lamps of kind dome: only they have a shutter cable")
        return self


def read_rig(path: Path) -> RigDescription:
    """Read the description of a rig. UserError names every wrong key, and the file."""
    return parse(RigDescription, read_yaml(path), str(path))


def open_rig(path: Path) -> Rig:
    """Open the devices that a description names; each is ready, and no axis has been homed.

    Parameters
    ----------
    path : Path
        The description, rig.yaml.

    Returns
    -------
    Rig
        A context manager: `with open_rig(path) as rig:` closes the devices.

    Raises
    ------
    UserError
        The description is wrong.
    DeviceError
        A device does not open; DeviceLost where it is not there.
    """
    description = read_rig(path)
    with ExitStack() as opened:
        lamps: Any = None
        if isinstance(description.lamps, DomeSettings):
            lamps = _keep(BracketDome("lamps", description.lamps), opened)
        elif description.lamps is not None:
            lamps = _keep(_open_own("lamps", description.lamps, path, DescribedLamps, HomeMadeLamps), opened)
        rig = Rig(
            lamps=lamps,
            axes=_open_axes(description.axes, path, opened),
            polarisers={
                name: _keep(
                    PromptedPolariser(f"polariser {name}", settings.states)
                    if isinstance(settings, PromptSettings)
                    else _open_own(f"polariser {name}", settings, path, DescribedPolariser, HomeMadePolariser),
                    opened,
                )
                for name, settings in description.polarisers.items()
            },
            camera=_keep(_open_camera(description.camera, path, lamps), opened),
        )
        opened.pop_all()  # everything is open: from here on the rig closes it
    return rig


def _keep(device: Any, opened: ExitStack) -> Any:
    """Keep a device open; close it where a later one does not open."""
    opened.callback(device.close)
    return device


def _open_axes(axes: dict[str, Any], path: Path, opened: ExitStack) -> dict[str, Any]:
    controllers: dict[str, Grbl] = {}
    devices: dict[str, Any] = {}
    for name, axis in axes.items():
        if isinstance(axis, GrblSettings):
            if axis.port not in controllers:
                controllers[axis.port] = _keep(Grbl(f"controller of {name}", axis.port, axis.baud), opened)
            devices[name] = GrblAxis(name, controllers[axis.port], axis)
        elif isinstance(axis, ComXimSettings):
            devices[name] = _keep(ComXimTurntable(name, axis), opened)
        else:
            devices[name] = _keep(_open_own(name, axis, path, DescribedAxis, HomeMadeAxis), opened)
    return devices


def _open_camera(settings: Any, path: Path, lamps: Any) -> Any:
    if isinstance(settings, GPhotoSettings):
        return GPhotoCamera("camera", settings)
    if isinstance(settings, PythonDevice):
        return _own_class(settings, path)
    release: Callable[[], None] | None = None
    if settings.release == "lamps":
        release = lamps.release
    elif settings.release != "operator":
        release = run_command("camera", settings.release)
    return WatchedFolder("camera", path.parent / settings.folder, settings, release)


def _open_own(name: str, settings: Any, path: Path, model: type[Closed], device: Callable[..., Any]) -> Any:
    """Open a device of the laboratory's own, described in YAML or by a class in Python."""
    if isinstance(settings, PythonDevice):
        return _own_class(settings, path)
    file = path.parent / settings.file
    values = read_yaml(file)
    return device(name, parse(model, values | ({"port": settings.port} if settings.port else {}), str(file)))


def _own_class(settings: PythonDevice, path: Path) -> Any:
    """Build the object that a Python file of the laboratory defines."""
    file = path.parent / settings.file
    if not file.is_file():
        raise UserError(f"{path}: no file {file}. Remedy: correct 'file', relative to the description")
    spec = importlib.util.spec_from_file_location(f"rig_device_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise UserError(f"{path}: expected a Python file (.py), found {file}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    device = getattr(module, settings.name, None)
    if device is None:
        raise UserError(f"{path}: {file} has no class '{settings.name}'. Remedy: correct 'name'")
    return device(**settings.options)


def read_yaml(path: Path) -> dict:
    """Read keys and values of a rig's YAML file; `off` and `on` are words. UserError where it cannot be read."""
    try:
        return read_mapping(path, UnquotedStatesLoader)
    except CaptureError as error:
        missing = any(problem.kind == "yaml-missing" for problem in error.problems)
        if missing:
            raise UserError(
                f"{path}: file not found. Remedy: correct its name; docs/devices/README.md shows how to write one"
            ) from None
        raise


DRIVERS = {
    (0x1A86, 0x7523): "CH340 adapter: many Arduino copies, ComXim turntables",
    (0x10C4, 0xEA60): "CP210x adapter",
    (0x0403, 0x6001): "FTDI adapter",
    (0x2341, 0x0043): "Arduino Uno: often GRBL or a dome",
    (0x2341, 0x0001): "Arduino Uno: often GRBL or a dome",
}
"""Usual devices behind a USB adapter, by vendor and product."""


def serial_ports() -> tuple[list[str], list[str]]:
    """Return a line for each serial port on USB, and for each other one: its stable name and description."""
    optional("pyserial")
    from serial.tools import list_ports

    stable = {os.path.realpath(path): path for path in glob.glob("/dev/serial/by-id/*")}
    on_usb, others = [], []
    for port in sorted(list_ports.comports()):
        name = stable.get(os.path.realpath(port.device), port.device)
        if port.vid is None:
            others.append(f"{name}  not on USB")
            continue
        maker = " ".join(text for text in (port.manufacturer, port.product) if text) or port.description
        often = DRIVERS.get((port.vid, port.pid))
        on_usb.append(f"{name}  {maker} (vendor {port.vid:04x}, product {port.pid:04x}{f'; {often}' if often else ''})")
    return on_usb, others


def camera_ports() -> list[str]:
    """Return a line for each camera on USB; empty where none is there or libgphoto2 is not installed."""
    if not is_installed("gphoto2"):
        return []
    from nishiki.rig.cameras import cameras

    return [f"{port}  {name}" for name, port in cameras()]


class OpenedRig:
    """Open devices that some frames need.

    Parameters
    ----------
    description : Path
        Description of the rig.
    frames : tuple of PlannedFrame
        Photographs to take.
    open_devices : callable
        Opens the devices of a description.
    """

    def __init__(
        self, description: Path, frames: tuple[PlannedFrame, ...], open_devices: Callable[[Path], Rig]
    ) -> None:
        self._description, self._frames, self._open_devices = description, frames, open_devices
        self._rig: Rig | None = None
        self._exposure: tuple[Exposure, Exposure] | None = None  # as asked for, as the camera set it

    def open_devices(self) -> Rig:
        """Open the devices and home them. UserError where a frame requires a device missing in the rig; DeviceError."""
        if self._rig is None:
            rig = self._open_devices(self._description)
            with closed_on_failure(rig):
                expect_devices(self._frames, rig)
                if any(frame.axes for frame in self._frames):
                    rig.home()
            self._rig, self._exposure = rig, None
        return self._rig

    def close(self) -> None:
        """Close what is open; the next use opens it again."""
        if self._rig is not None:
            self._rig.close()
            self._rig = None

    def set_up(self, frame: PlannedFrame, seconds: float | None) -> float | None:
        """Turn, light and set everything for a frame; return the exposure in seconds that the camera has set."""
        rig = self.open_devices()
        for name, state in frame.polarisers:
            rig.polarisers[name].set(state)
        for name, angle in frame.axes:
            axis = rig.axes[name]
            straight = getattr(axis, "straight", False)
            axis.move_to(reachable_angle(angle, axis.range_deg, f"{frame.file}: axis {name}", straight=straight))
        if rig.lamps is not None and (frame.lamp is not None or frame.group == "dark"):
            rig.lamps.light(frame.lamp)
        wanted = Exposure(seconds, frame.aperture, frame.iso)
        if self._exposure is None or self._exposure[0] != wanted:
            self._exposure = (wanted, rig.camera.configure(wanted))
        return self._exposure[1].seconds or seconds


def expect_devices(frames: tuple[PlannedFrame, ...], rig: Rig | RigDescription) -> None:
    """Raise UserError where frames need lamps, axes, angles or polarisers that a rig lacks."""
    wanted = {frame.lamp for frame in frames if frame.lamp is not None}
    count = getattr(rig.lamps, "count", math.inf) if rig.lamps is not None else 0
    if wanted and max(wanted) > count:
        raise UserError(f"plan: expected a rig with lamp {max(wanted)}, found {count} lamps in its description")
    for kind, names, devices in (
        ("axis", {name for frame in frames for name, _ in frame.axes}, rig.axes),
        ("polariser", {name for frame in frames for name, _ in frame.polarisers}, rig.polarisers),
    ):
        if missing := sorted(names - set(devices)):
            there = ", ".join(devices) or "none"
            where = f"plan: no {kind} '{missing[0]}' in the rig's description, which has {there}"
            raise UserError(f"{where}. Remedy: use one name in both")
    for frame in frames:
        for name, angle in frame.axes:
            limits, straight = (getattr(rig.axes[name], key, None) for key in ("range_deg", "straight"))
            if limits is not None:
                reachable_angle(angle, limits, f"plan: {frame.file}: axis {name}", straight=bool(straight))
        for name, state in frame.polarisers:
            states = getattr(rig.polarisers[name], "states", None)
            if states is not None and state not in states:
                raise UserError(f"plan: {frame.file}: polariser {name} has {', '.join(states)}, not '{state}'")


def reachable_angle(angle: float, limits: tuple[float, float], where: str, *, straight: bool = False) -> float:
    """Return the angle, or the same direction one turn away, inside the range of an axis; straight axes have no turn.

    Raises UserError where the axis does not reach it.
    """
    for turned in (angle,) if straight else (angle, angle - 360, angle + 360):
        if limits[0] - 1e-9 <= turned <= limits[1] + 1e-9:
            return turned
    unit = "mm" if straight else "degrees"
    raise UserError(f"{where}: expected {limits[0]:g} to {limits[1]:g} {unit}, found {angle:g}")
