"""The page of a run that is under way: what it shows, who may see it, and that it changes in a browser."""

import http.client
import shutil
import subprocess
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from captures import CHANNELS, make_capture
from pages import parsed
from refusals import refused
from rig_devices import Bench, write_plan

from nishiki.capture.schema import CameraResponse
from nishiki.errors import UserError
from nishiki.rig.frames_table import PlannedFrame
from nishiki.rig.live_page import SCRIPT, page_html, serve
from nishiki.rig.records import RunState, measure
from nishiki.rig.run import run_capture

CAMERA = CameraResponse(channels=CHANNELS, bits=12, black_level=100)


@pytest.fixture
def state():
    frames = tuple(PlannedFrame(f"frames/L{i}.png", "sample", lamp=i, light=f"L{i}", seconds=3.0) for i in range(1, 5))
    state = RunState()
    state.record_start(frames, {"frames/L1.png"}, CAMERA)
    rng = np.random.default_rng(1)
    codes = (100 + rng.random((60, 80, 3)) * 3000).astype(np.uint16)
    codes[:6] = 4095
    state.record_photograph(frames[1], codes, measure(codes, CAMERA, None))
    reasons = ["brightness is 0.2 <of> what its neighbours lead to expect"]
    state.record_event(
        {"time": "2026-11-23T10:11:12.000+00:00", "event": "rejected", "file": "frames/L2.png", "reasons": reasons}
    )
    return state


def text_of(url):
    with urllib.request.urlopen(url, timeout=20) as answer:
        return answer.read().decode()


def test_the_page_shows_the_photograph_what_is_left_and_what_was_repeated(state):
    html = page_html(state, "Landscape <1>")
    parsed(html.replace(SCRIPT, "").replace("<meta http-equiv", "<meta name"))
    assert "Landscape &lt;1&gt;" in html
    assert "frames/L2.png" in html
    assert "0.2 &lt;of&gt; " in html
    assert "10:11:12" in html
    assert "10.00%" in html
    assert "1 of 4 kept, 1 lamps" in html
    assert html.count('<img src="data:image/') == 1
    assert "http://" not in html.replace("http://www.w3.org", "")


def test_saturated_pixels_are_red(state, tmp_path):
    import base64

    import cv2

    html = page_html(state, "x")
    data = html.split(";base64,", 1)[1].split('"', 1)[0]
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert picture.shape == (60, 80, 3)
    red = (picture[..., 0] > 200) & (picture[..., 1] < 60) & (picture[..., 2] < 160)
    assert red[:5].mean() > 0.95
    assert red[7:].mean() < 0.05


def test_only_this_computer_is_answered_by_its_own_name(state):
    with serve(state, "x", 0) as address:
        host, port = address.removeprefix("http://").rstrip("/").split(":")
        assert host == "127.0.0.1"
        assert "frames/L2.png" in text_of(address)
        for path, name in (("/", "elsewhere.example"), ("/frames", host)):
            connection = http.client.HTTPConnection(host, int(port), timeout=20)
            connection.request("GET", path, headers={"Host": f"{name}:{port}"})
            assert connection.getresponse().status == 404
            connection.close()
        with refused(UserError, port), serve(state, "x", int(port)):
            pass
    with pytest.raises(OSError, match="refused"):
        text_of(address)


def test_a_run_is_followed_from_its_first_frame_to_its_seal(tmp_path):
    hand = make_capture(tmp_path / "hand")
    bench, state, seen = Bench(hand), RunState(), []

    with serve(state, "capture", 0) as address:
        bench.disturb = lambda device: seen.append(text_of(address)) if device == "photograph" else None
        run_capture(
            Path("rig.yaml"),
            write_plan(tmp_path, hand),
            tmp_path / "capture",
            observer=state,
            open_devices=bench.open,
            ask=bench.ask,
        )
        assert "<small>of 11" in text_of(address)
    assert [f"<strong>{n}<small>of 11" in page for n, page in enumerate(seen)] == [True] * 11
    assert ["white/L01.png" in page for page in seen[:2]] == [False, True]


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="no chromium: the page is not tried in a browser")
def test_a_browser_shows_the_state_that_comes_after_the_page_was_loaded(state, tmp_path):
    """The browser waits for eight seconds of its own time; the next frame is kept as soon as it has loaded the page."""
    with serve(state, "Landscape", 0) as address:
        browser = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
        browser += ["--virtual-time-budget=8000", "--dump-dom", address]

        def keep_next() -> None:
            time.sleep(0.01)
            while state.reads < 1:
                time.sleep(0.01)
            state.record_event({"event": "frame", "file": "frames/L3.png"})

        state.reads = 0
        began = state.seconds_left

        def count() -> float:
            state.reads += 1
            return began()

        state.seconds_left = count
        threading.Thread(target=keep_next, daemon=True).start()
        done = subprocess.run(browser, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "frames/L3.png" in done.stdout
    assert "2 of 4 kept" in done.stdout
