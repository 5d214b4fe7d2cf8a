"""Every case of stability is on the page, and the list of what failed at first names cases that exist."""

import pytest
from stability.page import PAGE, TITLES, found, load


def test_every_case_is_on_the_page():
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    assert not [item.name for item in load() if not any(line.startswith(f"| {item.name} |") for line in lines)]


@pytest.mark.slow
def test_every_case_belongs_to_a_section():
    assert {item.area for item in load()} <= set(TITLES)


def test_what_failed_at_first_is_a_case_now():
    names = {item.name for item in load()}
    rows = found()
    assert not [row["case"] for row in rows if row["case"] not in names]
    assert all(set(row) == {"case", "seen", "mended"} for row in rows)
