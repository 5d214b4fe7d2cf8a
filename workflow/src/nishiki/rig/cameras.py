"""Take photographs with a camera on a USB cable (libgphoto2) or through a folder that other software fills.

The names of settings differ between makers; the exposure is set where a camera has one of the known names. A camera
that sleeps or is unplugged is lost, and can be opened again.

The camera is released by the operator, by the shutter cable of a dome, or by a command; the photograph is what then
appears in the folder. Files are copied, and stay in the folder for the camera's software.
"""

import math
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from nishiki.artifacts.declaration import Closed
from nishiki.installation import optional
from nishiki.rig.device import (
    DELIVERY_S,
    POLL_S,
    QUIET_S,
    DeviceError,
    DeviceLost,
    Exposure,
    Files,
    Pause,
    Seconds,
    closed_on_failure,
)

WIDGETS = {
    "seconds": ("shutterspeed", "shutterspeed2", "exposuretime"),
    "aperture": ("f-number", "aperture"),
    "iso": ("iso", "isospeed"),
}
"""Names of the settings of an exposure, by libgphoto2's drivers."""
LARGEST_STEP = 2.0
"""Largest accepted ratio of a camera's nearest setting to the requested one: one stop."""
LOST = {-7, -10, -33, -35, -52, -105, -110}
"""libgphoto2's errors of disconnected or sleeping cameras: input and output, time-outs, USB, not found, busy."""


class GPhotoSettings(Closed):
    """A camera on USB."""

    kind: Literal["gphoto"]
    model: str | None = Field(None, description="as ./nishiki rig ports prints it; left out: the only camera")
    port: str | None = Field(None, description="such as usb:001,004, where there are several of a model")
    files: Files = Field(1, description="files of one exposure; 2: raw and JPEG")
    settings: dict[str, str] = Field({}, description="further settings, by libgphoto2's names")


class GPhotoCamera:
    """A camera on a USB cable."""

    def __init__(self, name: str, settings: GPhotoSettings) -> None:
        self.name, self.files, self.exposure_s = name, settings.files, 0.0
        self.gphoto: Any = optional("gphoto2")
        self.camera: Any = self._open(settings.model, settings.port)
        with closed_on_failure(self):
            for key, value in settings.settings.items():
                self._choose(key, value)

    def configure(self, exposure: Exposure) -> Exposure:
        """Set exposure time, aperture and sensitivity to the camera's nearest steps; return these."""
        for quantity in WIDGETS:
            value = getattr(exposure, quantity)
            if value is not None:
                self._set_nearest(quantity, float(value))
        iso = self._value("iso")
        taken = Exposure(self._value("seconds"), self._value("aperture"), None if iso is None else int(iso))
        self.exposure_s = taken.seconds or exposure.seconds or 0.0
        return taken

    def photograph(self, folder: Path) -> tuple[Path, ...]:
        """Take one exposure and download it. Other files on the camera's card stay there."""
        try:
            places = self._expose()
        except self.gphoto.GPhoto2Error as error:
            focus = "Remedy: switch the lens to manual focus, look at the camera's display, and run again"
            raise self._failure("taking a photograph", error, focus) from None
        if len(places) != self.files:
            names = ", ".join(sorted(file for _, file in places))
            raise DeviceError(
                f"{self.name}: expected {self.files} file(s) of one exposure, received {names}. "
                "Remedy: set its picture format (raw, JPEG, or both) and 'files' of the description to the same"
            )
        paths = []
        for place, file in sorted(places, key=lambda item: item[1]):
            paths.append(folder / file)
            try:
                self.camera.file_get(place, file, self.gphoto.GP_FILE_TYPE_NORMAL).save(str(paths[-1]))
            except self.gphoto.GPhoto2Error as error:
                text = f"{self.name}: downloading {file}: libgphoto2 says {error.string!r} ({error.code})"
                raise DeviceLost(f"{text}. Remedy: check cable and battery, then run the same command again") from None
        return tuple(paths)

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        camera, self.camera = self.camera, None
        if camera is not None:
            with suppress(self.gphoto.GPhoto2Error):  # it has gone already
                camera.exit()

    def _expose(self) -> set[tuple[str, str]]:
        """Release, and wait for all files of the exposure; return their folders and names on the camera."""
        first = self.camera.capture(self.gphoto.GP_CAPTURE_IMAGE)
        places = {(first.folder, first.name)}
        end = time.monotonic() + DELIVERY_S + self.exposure_s
        while time.monotonic() < end:
            kind, data = self.camera.wait_for_event(int(1000 * QUIET_S))
            if kind == self.gphoto.GP_EVENT_FILE_ADDED:
                places.add((data.folder, data.name))
            elif kind == self.gphoto.GP_EVENT_TIMEOUT and len(places) >= self.files:
                break
        return places

    def _open(self, model: str | None, port: str | None) -> Any:
        connected = [seen for seen in cameras() if model in (None, seen[0]) and port in (None, seen[1])]
        wanted = " at ".join(text for text in (model, port) if text) or "a camera"
        if not connected:
            remedy = "switch it on, set its USB mode to PTP, wake it up; ./nishiki rig ports lists what is connected"
            raise DeviceLost(f"{self.name}: expected {wanted} on USB, found none. Remedy: {remedy}")
        if len(connected) > 1:
            found = ", ".join(f"{name} at {place}" for name, place in connected)
            raise DeviceError(f"{self.name}: expected {wanted}, found several: {found}. Remedy: name model or port")
        gphoto = self.gphoto
        try:
            camera = gphoto.Camera()
            ports = gphoto.PortInfoList()
            ports.load()
            camera.set_port_info(ports[ports.lookup_path(connected[0][1])])
            camera.init()
            return camera
        except gphoto.GPhoto2Error as error:
            raise self._failure("opening it", error, "Remedy: switch it off and on and run again") from None

    def _widget(self, name: str) -> Any:
        """Return a setting of the camera, or None where it has none of this name."""
        try:
            return self.camera.get_single_config(name)
        except self.gphoto.GPhoto2Error as error:
            if error.code in LOST:
                raise self._failure(f"reading the setting '{name}'", error) from None
            return None

    def _exposure_setting(self, quantity: str) -> Any:
        return next((widget for name in WIDGETS[quantity] if (widget := self._widget(name)) is not None), None)

    def _value(self, quantity: str) -> float | None:
        """Read a setting of the camera; None where it is not reported."""
        widget = self._exposure_setting(quantity)
        return None if widget is None else number_of(str(widget.get_value()))

    def _set_nearest(self, quantity: str, value: float) -> None:
        widget = self._exposure_setting(quantity)
        if widget is None or widget.get_readonly():
            raise DeviceError(
                f"{self.name}: {quantity} cannot be set from here, found {value:g} in the plan. Remedy: set it at the "
                "camera or lens (mode M) and leave it out of the plan"
            )
        steps = {number: text for text in choices(widget) if (number := number_of(text)) is not None}
        near = min(steps, key=lambda number: abs(math.log(number / value)), default=None)
        if near is None or max(near / value, value / near) > LARGEST_STEP:
            known = ", ".join(steps.values()) or "none"
            raise DeviceError(
                f"{self.name}: expected one of its steps of {quantity}, found {value:g}. There are: {known}. Remedy: "
                "use one of these, or mode M"
            )
        self._set(widget, steps[near])

    def _choose(self, name: str, value: str) -> None:
        widget = self._widget(name)
        if widget is None:
            names = ", ".join(sorted(setting_names(self.camera.get_config())))
            raise DeviceError(f"{self.name}: it has no setting '{name}'. Remedy: choose among {names}")
        known = choices(widget)
        if known and value not in known:
            raise DeviceError(
                f"{self.name}: setting '{name}' cannot be '{value}'. Remedy: choose among {', '.join(known)}"
            )
        self._set(widget, value)

    def _set(self, widget: Any, text: str) -> None:
        name = widget.get_name()
        try:
            widget.set_value(text)
            self.camera.set_single_config(name, widget)
        except self.gphoto.GPhoto2Error as error:
            raise self._failure(f"setting '{name}' to '{text}'", error, "Remedy: set the camera to mode M") from None

    def _failure(self, action: str, error: Any, remedy: str = "Remedy: switch it off and on") -> DeviceError:
        what = f"{self.name}: {action}: libgphoto2 says {error.string!r} ({error.code})"
        if error.code == self.gphoto.GP_ERROR_IO_USB_CLAIM:
            text = "another program has the camera. Remedy: unmount it in the file manager, or close its own software"
            return DeviceError(f"{what}: {text}")
        if error.code in LOST:
            text = "Remedy: wake it up, switch off its sleep timer, check cable and battery, and run the same command"
            return DeviceLost(f"{what}. {text} again")
        return DeviceError(f"{what}. {remedy}")


def cameras() -> list[tuple[str, str]]:
    """List model and port of every camera on USB that libgphoto2 finds."""
    gphoto: Any = optional("gphoto2")
    return [(str(name), str(port)) for name, port in gphoto.Camera.autodetect()]


def choices(widget: Any) -> list[str]:
    """List the choices of a setting; empty where it is free text or a number."""
    try:
        return [str(choice) for choice in widget.get_choices()]
    except Exception:  # GPhoto2Error: a setting of another kind
        return []


def setting_names(widget: Any) -> list[str]:
    """List names of all settings below one."""
    children = list(widget.get_children())
    return [name for child in children for name in setting_names(child)] if children else [widget.get_name()]


def number_of(text: str) -> float | None:
    """Parse a camera's value: 1/60, 0.0100s, 2.5, 30", f/5.6, F8, 400; None for auto or bulb.

    Examples
    --------
    >>> number_of("1/60")
    0.016666666666666666
    >>> number_of("f/5.6")
    5.6
    >>> number_of("Auto") is None
    True
    """
    match = re.fullmatch(r"(?:[fF]/?)?\s*(\d+(?:[.,]\d+)?)(?:/(\d+(?:\.\d+)?))?\s*(?:s|sec|\")?", text.strip())
    if not match:
        return None
    number = float(match[1].replace(",", ".")) / float(match[2] or 1) if float(match[2] or 1) else 0.0
    return number or None


UNFINISHED = (".tmp", ".part", ".partial", ".crdownload", "~")
"""Endings of names of incomplete files."""


class FolderSettings(Closed):
    """Camera whose own software puts its photographs into a folder."""

    kind: Literal["folder"]
    folder: str = Field(description="that folder")
    release: Literal["operator", "lamps"] | tuple[str, ...] = Field(
        "operator", description="who releases: operator, lamps (the dome's shutter cable), or a command as a list"
    )
    files: Files = Field(1, description="files of one exposure; 2: raw and JPEG")
    wait_s: Seconds = Field(120.0, description="seconds from the release until the files are there")
    complete_s: Pause = Field(1.0, description="seconds for which the size of a complete file does not change")


class WatchedFolder:
    """A camera whose photographs appear in a folder.

    Parameters
    ----------
    name : str
        Name in messages.
    folder : Path
        Where its software puts the photographs.
    settings : FolderSettings
    release : callable or None
        Releases the camera; None: the operator does.
    """

    def __init__(
        self, name: str, folder: Path, settings: FolderSettings, release: Callable[[], None] | None = None
    ) -> None:
        self.name, self.folder, self.files, self.release = name, folder, settings.files, release
        self.wait_s, self.complete_s = settings.wait_s, settings.complete_s
        self.known = set(self._sizes())

    def configure(self, exposure: Exposure) -> Exposure:
        """Raise DeviceError for any setting: the exposure is set in the camera's own software."""
        if exposure != Exposure():
            raise DeviceError(
                f"{self.name}: the exposure of this camera is set in its software (mode M). Remedy: omit it from the "
                "plan"
            )
        return Exposure()

    def photograph(self, folder: Path) -> tuple[Path, ...]:
        """Release the camera, wait until the files of one exposure are complete, and copy them."""
        self._expect_nothing_new(set(self._sizes()) - self.known)
        if self.release is None:
            number = "" if self.files == 1 else f" ({self.files} files)"
            print(f"{self.name}: release the camera now{number}", file=sys.stderr, flush=True)
        else:
            self.release()
        names = self._wait()
        self.known |= names
        paths = []
        for name in sorted(names):
            paths.append(folder / name)
            try:
                shutil.copyfile(self.folder / name, paths[-1])
            except FileNotFoundError:
                raise DeviceLost(
                    f"{self.name}: {self.folder / name} disappeared before it was copied. "
                    "Remedy: switch off what moves or renames files there, then run the same command again"
                ) from None
        return tuple(paths)

    def close(self) -> None:
        """Do nothing: no device is open."""

    def _wait(self) -> set[str]:
        """Return names of the files of one exposure, once they are complete."""
        end = time.monotonic() + self.wait_s
        sizes: dict[str, int] = {}
        since = time.monotonic()
        while True:
            now = {name: size for name, size in self._sizes().items() if name not in self.known}
            if now != sizes:
                sizes, since = now, time.monotonic()
            if len(sizes) > self.files:
                self._expect_nothing_new(set(sizes))
            complete = len(sizes) == self.files and all(sizes.values())
            if complete and time.monotonic() - since >= self.complete_s:
                return set(sizes)
            if time.monotonic() > end:
                found = ", ".join(f"{name} ({size} bytes)" for name, size in sorted(sizes.items())) or "nothing"
                raise DeviceLost(
                    f"{self.name}: expected {self.files} new file(s) in {self.folder} within {self.wait_s:g} s, found "
                    f"{found}. Remedy: check that camera and software work, then run the same command again"
                )
            time.sleep(POLL_S)

    def _expect_nothing_new(self, names: set[str]) -> None:
        if names:
            raise DeviceError(
                f"{self.name}: expected {self.files} file(s) for one exposure in {self.folder}, found "
                f"{', '.join(sorted(names))}. Remedy: release only when asked, set 'files' (2 for raw and JPEG), run "
                "again"
            )

    def _sizes(self) -> dict[str, int]:
        """Return the bytes of every photograph in the folder."""
        try:
            entries = [entry for entry in self.folder.iterdir() if not entry.name.startswith(".")]
        except OSError as error:
            raise DeviceLost(
                f"{self.name}: the folder {self.folder} cannot be read ({error.strerror}). "
                "Remedy: make or mount it, or correct the description, then run the same command again"
            ) from None
        sizes = {}
        for entry in entries:
            try:
                if entry.is_file() and not entry.name.endswith(UNFINISHED):
                    sizes[entry.name] = entry.stat().st_size
            except FileNotFoundError:
                continue  # renamed by the camera's software between the two looks
        return sizes


def run_command(name: str, command: tuple[str, ...]) -> Callable[[], None]:
    """Make a release that runs a command, such as that of the camera's software."""

    def release() -> None:
        text = " ".join(command)
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=DELIVERY_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DeviceError(f"{name}: the command '{text}' failed ({error}). Remedy: correct 'release'") from None
        if done.returncode:
            said = (done.stderr or done.stdout).strip()[-300:]
            status = f"ended with status {done.returncode}: {said or 'no message'}"
            raise DeviceError(f"{name}: the command '{text}' {status}. Remedy: try it in a terminal")

    return release
