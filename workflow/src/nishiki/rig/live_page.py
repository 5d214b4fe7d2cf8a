"""Serve the page of a capture run in progress to a browser on this computer."""

import contextlib
import errno
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from nishiki.errors import UserError
from nishiki.observations.linearise import saturation_code
from nishiki.report.page import Block, Facts, Figure, Figures, Metric, Note, Page, PageSection, Table, render_page
from nishiki.report.pictures import colour_picture
from nishiki.report.svg import PALETTE, ChartCurve, Drawing, chart
from nishiki.rig.frames_table import duration
from nishiki.rig.records import LastPhotograph, RunState, light_of, why
from nishiki.version import PROJECT_VERSION

ADDRESS = "127.0.0.1"
DEFAULT_PORT = 8377  # of this computer alone
REFRESH_MS = 1000
CLIPPED = (1.0, 0.0, 0.1)  # linear sRGB of saturated pixels
BINS = 128  # of the histogram
CELL, ACROSS = 14, 48  # size of a frame's mark and number of marks in a row
KEPT, AGAIN, MISSING = "#3f7f4c", "#c9803f", "#dcdbd5"
CHANNEL_COLOURS = {1: ("#22262b",), 3: ("#b5342b", "#3f7f4c", "#1f4e79")}
SCRIPT = f"""<script>
async function refresh() {{
  try {{
    const text = await (await fetch("/")).text();
    const page = new DOMParser().parseFromString(text, "text/html");
    for (const part of ["header", "main", "footer"])
      document.querySelector(part).replaceWith(page.querySelector(part));
  }} catch (error) {{
    document.querySelector(".scene").textContent = "The run has ended: see its terminal";
  }}
  setTimeout(refresh, {REFRESH_MS});
}}
setTimeout(refresh, {REFRESH_MS});
</script>
"""
"""Script that updates the page without moving it; without scripts the browser reloads it."""


@contextlib.contextmanager
def serve(state: RunState, title: str, port: int = DEFAULT_PORT) -> Iterator[str]:
    """Serve the page of a run on this computer only, until the block ends; yield its address.

    Parameters
    ----------
    state : RunState
        State that the page shows.
    title : str
        Name of the capture.
    port : int
        0: any that is free.

    Raises
    ------
    UserError
        Another program has the port.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").rpartition(":")[0]
            if self.path != "/" or host not in (ADDRESS, "localhost"):  # a name that leads here is a stranger's page
                self.send_error(404)
                return
            content = page_html(state, title).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: object) -> None:
            """Suppress messages on the terminal, which shows the run."""

    try:
        server = ThreadingHTTPServer((ADDRESS, port), Handler)
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        why = error.strerror
        raise UserError(f"--page: port {port} cannot be used ({why}). Remedy: --page 0 takes a free one") from None
    thread = threading.Thread(target=server.serve_forever, name="page of the run", daemon=True)
    thread.start()
    try:
        yield f"http://{ADDRESS}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def page_html(state: RunState, title: str) -> str:
    """Build the page: one self-contained HTML file."""
    with state.lock:
        kept, total = len(state.kept), len(state.frames)
        sections = [PageSection("last", "The last photograph", _last(state.last, state))] if state.last else []
        rows = [(event["time"][11:19], event["file"], why(event)) for event in state.repeated[::-1]]
        repeats = Table(("time", "frame", "why"), rows, "llw") if rows else Note(["Nothing so far."])
        sections += [
            PageSection("frames", "Frames", _frames(state)),
            PageSection("repeated", "What was repeated, and why", [repeats]),
        ]
        tiles = [
            Metric(kept, f"of {total}", "frames are kept"),
            Metric(round(state.seconds_left() / 60, 1), "min", "left, as it goes"),
            Metric(len(state.repeated), "", "frames were taken again"),
        ]
        if state.last:
            tiles.append(Metric(100 * state.last.measures.saturated, "%", "of the last photograph is saturated"))
        footer = f"Nishiki {PROJECT_VERSION}. This page is seen on this computer only."
        page = Page(title, state.doing, sections, PROJECT_VERSION, footer, tiles=tiles)
    noscript = f'<noscript><meta http-equiv="refresh" content="{REFRESH_MS // 1000 + 1}"></noscript>'
    html = render_page(page)
    return html.replace("</head>", f"{noscript}\n</head>", 1).replace("</body>", f"{SCRIPT}</body>", 1)


def _last(last: LastPhotograph, state: RunState) -> list[Block]:
    measures, frame = last.measures, last.frame
    light = light_of(last.codes, state.camera)
    colours = light if light.shape[2] == 3 else np.repeat(light.mean(axis=2, keepdims=True), 3, axis=2)
    peak = max(measures.peak, 1e-6)
    shown = np.array(colours / peak, np.float32)
    limit = saturation_code(last.codes.dtype, state.camera.saturation, state.camera.bits)
    shown[(last.codes >= limit).any(axis=2)] = CLIPPED
    caption = f"Brightened {1 / peak:.1f} times. Saturated pixels are red."
    where = [("role", frame.role), ("lamp", str(frame.lamp) if frame.lamp else ""), ("light", frame.light)]
    where += [("view", frame.view), ("polariser", frame.polariser)]
    where += [(name, f"{angle:g}°") for name, angle in frame.axes]
    facts = [(label, text) for label, text in where if text]
    facts += [
        ("mean light", f"{measures.level:.1%} of full scale"),
        ("saturated", f"{measures.saturated:.2%} of the pixels"),
        ("without light", f"{measures.dark:.1%} of the pixels"),
        ("size", f"{measures.columns} × {measures.rows} pixels, {measures.channels} channels of {measures.sample}"),
    ]
    figures = [Figure(frame.file, caption, picture=colour_picture(shown)), Figure("Histogram", svg=_histogram(light))]
    return [Figures(figures), Facts(facts)]


def _histogram(light: np.ndarray) -> str:
    """Draw the histogram of light, each channel a curve; the scale of the counts is logarithmic."""
    edges = np.linspace(0, 1, BINS + 1)
    colours = CHANNEL_COLOURS.get(light.shape[2], PALETTE)
    curves = []
    for channel in range(light.shape[2]):
        counts, _ = np.histogram(np.clip(light[:, :, channel], 0, 1), edges)
        colour = colours[channel % len(colours)]
        curves.append(ChartCurve("", edges[:-1] + 0.5 / BINS, np.maximum(counts, 0.5), colour))
    top = max(10.0, max(float(curve.y.max()) for curve in curves))
    return chart(
        curves,
        x_label="light, of full scale",
        y_label="pixels",
        title="histogram of the last photograph",
        x_range=(0, 1),
        y_range=(0.5, top),
        logarithmic=True,
    )


def _frames(state: RunState) -> list[Block]:
    groups: dict[str, list] = {}
    for frame in state.frames:
        groups.setdefault(frame.role, []).append(frame)
    again = {event["file"] for event in state.repeated}
    items = []
    for role, frames in groups.items():
        rows = -(-len(frames) // ACROSS)
        drawing = Drawing(ACROSS * CELL, rows * CELL, f"{role} frames")
        for i, frame in enumerate(frames):
            x, y = i % ACROSS * CELL, i // ACROSS * CELL
            colour = (AGAIN if frame.file in again else KEPT) if frame.file in state.kept else MISSING
            side = CELL - 3
            drawing.path(f"M{x} {y}h{side}v{side}h-{side}z", tip=frame.light or frame.file, fill=colour)
        done = sum(frame.file in state.kept for frame in frames)
        lamps = len({frame.lamp for frame in frames if frame.lamp and frame.file in state.kept})
        caption = f"{done} of {len(frames)} kept" + (f", {lamps} lamps." if lamps else ".")
        items.append(Figure(role, caption, svg=drawing.finish()))
    note = "Green: kept. Orange: kept after a repetition. Grey: not taken yet."
    return [note, Figures(items, columns=1), f"About {duration(state.seconds_left())} left."]
