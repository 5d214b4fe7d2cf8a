"""Pictures for libgphoto2's virtual camera, which appears in a process that starts with VCAMERADIR set."""

from pathlib import Path

CAPACITY = 1 << 20
"""Bytes of every picture of the virtual camera: it keeps to the length that the file had when the camera was opened."""


class VirtualCamera:
    """The folder of a virtual camera, and the picture that it takes next.

    The camera releases 26 times in one process, then says that its card is full.

    Parameters
    ----------
    folder : Path
        Folder to make; VCAMERADIR names it.
    jpeg : bytes
        The first picture.
    """

    def __init__(self, folder: Path, jpeg: bytes) -> None:
        self.picture = folder / "DCIM" / "100NIKON" / "next.jpg"
        self.picture.parent.mkdir(parents=True)
        self.show(jpeg)

    def show(self, jpeg: bytes) -> None:
        """Put a picture before the lens: a JPEG file, which is filled up with bytes that readers skip."""
        if len(jpeg) > CAPACITY:
            raise ValueError(f"expected a picture of at most {CAPACITY} bytes, found {len(jpeg)}")
        self.picture.write_bytes(jpeg.ljust(CAPACITY, b"\0"))
