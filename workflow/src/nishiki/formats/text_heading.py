"""The words of a text heading that binary data follow, as in `.ptm` and `.rti` files."""

from __future__ import annotations

import re
from pathlib import Path

from nishiki.formats.files import Refused, expect_bound, open_regular

HEADING_BYTES = 4096  # more than any such heading has
LARGEST = 1e6  # of scales and biases, which belong to values of 0 to 255
WORD = re.compile(rb"[ \t\r\n]*([^ \t\r\n]+)(?=[ \t\r\n])")
LINE_END = re.compile(rb"[ \t]*\r?\n")
REMEDY = "Copy it again, or convert the photographs that it was made from"


class TextHeading:
    """Reads a heading word by word; name: of the file, size: of it in bytes.

    Refused by all methods where the heading is not as it should be.
    """

    def __init__(self, path: Path):
        self.name = path.name
        try:
            with open(open_regular(path, path.name), "rb") as file:
                self.start = file.read(HEADING_BYTES)
                self.size = file.seek(0, 2)
        except FileNotFoundError:
            raise Refused(path.name, "file is missing", remedy="Correct the path") from None
        except OSError as e:
            raise Refused(path.name, "cannot be read", found=str(e)) from None
        self.place = 0

    def skip_comments(self) -> None:
        """Go past the lines that begin with #."""
        while self.start[self.place : self.place + 1] == b"#":
            end = self.start.find(b"\n", self.place)
            self.place = end + 1 if end >= 0 else len(self.start)

    def word(self) -> str:
        """The next word, of at most 80 characters."""
        match = WORD.match(self.start, self.place)
        if match is None:
            raise Refused(self.name, "the heading ends early", remedy=REMEDY)
        self.place = match.end()
        return match[1][:80].decode("latin-1")

    def integers(self, count: int) -> list[int]:
        """The next whole numbers, below a thousand million."""
        return [int(each) for each in self._numbers(count, r"-?[0-9]{1,9}", "whole numbers")]

    def floats(self, count: int) -> list[float]:
        """The next numbers, none beyond LARGEST."""
        number = r"[-+]?([0-9]{1,30}\.?[0-9]{0,30}|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?"
        values = [float(each) for each in self._numbers(count, number, "numbers")]
        self.expect_sound(values)
        return values

    def expect_sound(self, values: list[float]) -> None:
        """Refused unless all numbers are finite and none is beyond LARGEST."""
        if not all(abs(value) <= LARGEST for value in values):
            expected, found = f"numbers up to {LARGEST:g}", " ".join(f"{value:g}" for value in values)
            raise Refused(self.name, "scales or biases that cannot be", expected=expected, found=found, remedy=REMEDY)

    def _numbers(self, count: int, pattern: str, kind: str) -> list[str]:
        found = [self.word() for _ in range(count)]
        if not all(re.fullmatch(pattern, each) for each in found):
            expected, seen = f"{count} {kind}", " ".join(found)[:80]
            raise Refused(self.name, "not the heading of such a file", expected=expected, found=seen, remedy=REMEDY)
        return found

    def picture_size(self, columns: int, rows: int) -> None:
        """Refused unless this is a size of pictures that are read."""
        if min(rows, columns) < 1:
            raise Refused(self.name, "a picture without pixels", found=f"{columns} x {rows}", remedy=REMEDY)
        expect_bound(max(rows, columns), "image_side", self.name)
        expect_bound(rows * columns, "image_pixels", self.name)

    def data(self, count: int) -> int:
        """Where the binary data begin, at least `count` bytes, after the end of the heading's last line."""
        end = LINE_END.match(self.start, self.place)
        if end is None:
            raise Refused(self.name, "the heading does not end with its line", remedy=REMEDY)
        if self.size < end.end() + count:
            expected, found = f"{end.end() + count} bytes", f"{self.size}"
            raise Refused(self.name, "the file ends early", expected=expected, found=found, remedy=REMEDY)
        return end.end()
