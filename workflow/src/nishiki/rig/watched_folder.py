"""Any camera with software of its own that puts its photographs into a folder.

The camera is released by the operator, by the shutter cable of a dome, or by a command; the photograph is what then
appears in the folder. Files are copied, and stay in the folder for the camera's software.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from nishiki.rig.device import DeviceError, DeviceLost, Exposure

UNFINISHED = (".tmp", ".part", ".partial", ".crdownload", "~")
"""Ends of the names of files that are being written."""
POLL_S = 0.05
COMMAND_S = 60.0
"""Seconds that a command may take that releases the camera."""


class WatchedFolder:
    """A camera whose photographs appear in a folder.

    Parameters
    ----------
    name : str
        Name in messages.
    folder : Path
        Where its software puts the photographs.
    release : callable or None
        Releases the camera; None: the operator does.
    files : int
        Files of one exposure: 1, or 2 for raw and JPEG.
    wait_s : float
        Seconds from the release until the files are there; for the operator too.
    complete_s : float
        Seconds for which the size of a file must not change before it is taken to be complete.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        release: Callable[[], None] | None = None,
        files: int = 1,
        wait_s: float = 120.0,
        complete_s: float = 1.0,
    ) -> None:
        self.name, self.folder, self.release = name, folder, release
        self.files, self.wait_s, self.complete_s = files, wait_s, complete_s
        self.known = set(self._sizes())

    def configure(self, exposure: Exposure) -> Exposure:
        """Exposure is set in the camera's own software; nothing is known of it here."""
        if exposure != Exposure():
            raise DeviceError(
                f"{self.name}: the exposure of a camera behind a folder cannot be set from here. "
                "Remedy: set it in the camera's software (mode M) and leave it out of the plan"
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
        """Nothing is held."""

    def _wait(self) -> set[str]:
        """Names of the files of one exposure, once they are complete."""
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
                    f"{self.name}: expected {self.files} new file(s) in {self.folder} within {self.wait_s:g} s, "
                    f"found {found}. Remedy: check that the camera is awake and that its software saves there, "
                    "then run the same command again"
                )
            time.sleep(POLL_S)

    def _expect_nothing_new(self, names: set[str]) -> None:
        if names:
            raise DeviceError(
                f"{self.name}: expected {self.files} file(s) for one exposure in {self.folder}, found "
                f"{', '.join(sorted(names))}: it is not certain which photograph belongs to this frame. "
                "Remedy: release the camera only when asked, set 'files' (2 for raw and JPEG), and run again"
            )

    def _sizes(self) -> dict[str, int]:
        """Bytes of every photograph in the folder."""
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
    """A release by a command, such as that of the camera's software."""

    def release() -> None:
        text = " ".join(command)
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMMAND_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DeviceError(
                f"{name}: the command '{text}' did not run ({error}). Remedy: correct 'release'"
            ) from None
        if done.returncode:
            said = (done.stderr or done.stdout).strip()[-300:]
            raise DeviceError(
                f"{name}: the command '{text}' ended with status {done.returncode}: {said or 'it said nothing'}. "
                "Remedy: try it in a terminal"
            )

    return release
