"""What is connected: serial ports with the makers of their adapters, and cameras."""

from __future__ import annotations

import glob
import os

from nishiki.packages import installed, optional

DRIVERS = {
    (0x1A86, 0x7523): "CH340 adapter: many Arduino copies, ComXim turntables",
    (0x10C4, 0xEA60): "CP210x adapter",
    (0x0403, 0x6001): "FTDI adapter",
    (0x2341, 0x0043): "Arduino Uno: often GRBL or a dome",
    (0x2341, 0x0001): "Arduino Uno: often GRBL or a dome",
}
"""What is often behind a USB adapter, by vendor and product."""


def serial_ports() -> tuple[list[str], list[str]]:
    """A line for each serial port on USB, and for each other one: its name that stays the same, and what it is."""
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
    """A line for each camera on USB; empty where none is there, or libgphoto2 is not installed."""
    if not installed("gphoto2"):
        return []
    from nishiki.rig.gphoto import cameras

    return [f"{port}  {name}" for name, port in cameras()]
