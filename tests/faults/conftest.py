"""What several tests of faults need."""

import time

import pytest


@pytest.fixture
def quick():
    """Fails where a test took more than five seconds of this process's time."""
    start = time.process_time()
    yield
    assert time.process_time() - start < 5
