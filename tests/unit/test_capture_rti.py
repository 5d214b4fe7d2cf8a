"""Hemispherical harmonics (`.rti`) become captures; their values are those of a slow decoder."""

import numpy as np
import pytest
from relightable_images import (
    COLUMNS,
    ROWS,
    expect_refusal,
    expect_values,
    expect_whole_files_only,
    harmonics_as_viewers_have_them,
    hsh_file,
    rgb_file,
)
from small_painting import dome

from nishiki.formats.legacy_rti import hemispherical_harmonics

FILES = {
    "four.rti": lambda: hsh_file(4),
    "nine.rti": lambda: hsh_file(9, "\r\n"),
    "sixteen.RTI": lambda: hsh_file(16),
}


@pytest.mark.parametrize("name", FILES)
def test_values_are_those_of_a_slow_decoder(tmp_path, name):
    expect_values(tmp_path / name, *FILES[name]())


@pytest.mark.parametrize(("terms", "written"), [(1, 1), (4, 1), (9, 2)])
def test_one_and_two_terms_are_a_degree_where_the_file_is_as_long(tmp_path, terms, written):
    content, value = hsh_file(terms)
    expect_values(tmp_path / "a.rti", content.replace(f"{terms} 2 1\n".encode(), f"{written} 2 1\n".encode()), value)


def test_harmonics_are_those_written_out():
    lights = np.concatenate([dome(30, 0), [[1, 0, 0], [0, 0, 1], [0.6, -0.8, 0]]])
    expected = [harmonics_as_viewers_have_them(each) for each in lights]
    np.testing.assert_allclose(hemispherical_harmonics(lights, 4), expected, atol=1e-12)


@pytest.mark.parametrize("name", FILES)
def test_files_that_end_anywhere_or_claim_too_much_are_refused(tmp_path, name):
    claims = [b"100000 100000 3", b"999999999 1 3", b"0 5 3", b"-3 5 3", b"9" * 30 + b" 1 3", b"x 5 3"]
    expect_whole_files_only(tmp_path / name, FILES[name]()[0], f"{COLUMNS} {ROWS} 3".encode(), claims)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (rgb_file()[0], "#HSH"),
        (hsh_file()[0].replace(b"9 2 1", b"9 1 1"), "basis 1"),
        (hsh_file()[0].replace(b"9 2 1", b"8 2 1"), "8 terms"),
        (hsh_file()[0].replace(b"9 2 1", b"2 2 1").replace(b"\n3\n", b"\n1\n"), "kind 1"),
    ],
)
def test_other_kinds_are_refused_by_name(tmp_path, content, text, capsys):
    expect_refusal(tmp_path / "a.rti", content, text, capsys)
