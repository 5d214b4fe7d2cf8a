"""Tables of the UTIA database become captures: a file written here value by value, and our own export."""

import math
import struct

import numpy as np
import pytest
from refusals import refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.goniometer_tables import read_table
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture


def reflected(channel, theta_i, phi_i, theta_r, phi_r):
    """Any smooth function in 1/sr that tells all five apart; along the normal it does not depend on the azimuth.

    It sends back at most .6 of the light.
    """
    tilt_i, tilt_r = math.sin(math.radians(theta_i)), math.sin(math.radians(theta_r))
    turned = 0.3 * tilt_i * math.cos(math.radians(phi_i - 20)) + 0.1 * tilt_r * math.sin(math.radians(phi_r))
    return (channel + 1) * (0.06 + 0.03 * turned + 0.015 * tilt_r)


@pytest.fixture(scope="module")
def content():
    values = (
        reflected(channel, 15 * ti, 7.5 * pi, 15 * tr, 7.5 * pr)
        for channel in range(3)
        for ti in range(6)
        for pi in range(48)
        for tr in range(6)
        for pr in range(48)
    )
    return b"".join(struct.pack("<d", value) for value in values)


def test_every_pair_of_directions_has_its_value_once(tmp_path, content):
    (tmp_path / "fabric.bin").write_bytes(content)
    table = read_table(tmp_path / "fabric.bin", "fabric.bin")
    assert table.channels == ("red", "green", "blue")
    pairs = np.column_stack([table.incident_deg, table.outgoing_deg])
    assert len(pairs) == len(np.unique(pairs, axis=0)) == 241 * 241
    for row in np.random.default_rng(1).integers(0, len(pairs), 200):
        expected = [reflected(channel, *pairs[row]) for channel in range(3)]
        np.testing.assert_allclose(table.values[row], expected, rtol=1e-12)


def test_a_table_is_converted_and_its_unit_said(tmp_path, content):
    (tmp_path / "s").mkdir()
    (tmp_path / "s/fabric.bin").write_bytes(content)
    made = convert(tmp_path / "s", tmp_path / "c")
    assert (made.geometry, made.photographs, made.channels) == ("goniometer", 241**2, ("red", "green", "blue"))
    assert {"table-scale"} == {note.kind for note in made.warnings}
    assert (tmp_path / "c/fabric.bin").read_bytes() == content
    assert len(load_capture(tmp_path / "c").angles_deg) == 241**2
    assert not [problem for problem in check_capture(tmp_path / "c") if problem.severity == "error"]


def test_other_files_are_no_such_table(tmp_path, content):
    (tmp_path / "fabric.bin").write_bytes(content[:-8])
    with pytest.raises(CaptureError, match=r"1990656 bytes.*1990648"):
        read_table(tmp_path / "fabric.bin", "fabric.bin")
    with refused(CaptureError, "1990656", "1990648", kind="table-unreadable"):
        convert(tmp_path / "fabric.bin", tmp_path / "c")
    (tmp_path / "fabric.bin").write_bytes(content[:80] + struct.pack("<d", math.nan) + content[88:])
    with refused(CaptureError, kind="table-value"):
        convert(tmp_path / "fabric.bin", tmp_path / "c")
    assert not (tmp_path / "c").exists()
