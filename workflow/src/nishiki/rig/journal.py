"""The journal of a capture run: one JSON line an event, appended and flushed to the disk, never changed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from nishiki.formats.files import flush_folder


class Journal:
    """An append-only file of events.

    A line that was cut off by a kill or a full disk is left as it is, and not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, event: str, **facts: Any) -> dict[str, Any]:
        """Append an event; it is on the disk when this returns. Returns the line's content."""
        line = {"time": datetime.now().astimezone().isoformat(timespec="milliseconds"), "event": event, **facts}
        is_new = not self.path.exists()
        with self.path.open("ab") as file:
            if not is_new and not self._ends_with_line():
                file.write(b"\n")
            file.write(json.dumps(line, ensure_ascii=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        if is_new:
            flush_folder(self.path.parent)
        return line

    def events(self) -> Iterator[dict[str, Any]]:
        """All complete events, in their order."""
        if not self.path.exists():
            return
        for line in self.path.read_bytes().split(b"\n"):
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                yield event

    def _ends_with_line(self) -> bool:
        with self.path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 1))
            return size == 0 or file.read(1) == b"\n"
