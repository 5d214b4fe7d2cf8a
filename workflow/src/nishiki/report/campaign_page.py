"""The page of all scenes of a configuration: a thumbnail, figures and state of each, with filters; one HTML file.

Pictures stand beside the page, in the folders of their scenes, and are loaded when they come into sight, so that a
page of several thousand scenes opens at once.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nishiki.report.numbers import figure
from nishiki.report.page import Tile, templates

STATES = {
    "finished": "finished",
    "unfinished": "not finished",
    "failed": "failed",
    "refused": "cannot be planned",
}
"""State of a scene, and what the page calls it."""


@dataclass(frozen=True)
class SceneCard:
    """What the page shows of a scene.

    Attributes
    ----------
    scene : str
        Its name in the scene table.
    state : str
        One of STATES.
    detail : str
        What comes next of an unfinished scene, why another one failed; empty for a finished one.
    title, about : str
        As on the page of the scene; empty where it has none yet.
    page, viewer, thumbnail : str
        Files relative to the folder of the results; empty where there is none.
    figures : sequence of Tile
        The figures that matter most.
    """

    scene: str
    state: str
    detail: str = ""
    title: str = ""
    about: str = ""
    page: str = ""
    viewer: str = ""
    thumbnail: str = ""
    figures: Sequence[Tile] = ()


def campaign_page(title: str, cards: Sequence[SceneCard], version: str) -> str:
    """HTML of the page. Scenes that need attention come first, then the others in the order given."""
    order = {"failed": 0, "refused": 0, "unfinished": 1, "finished": 2}
    cards = sorted(cards, key=lambda card: order[card.state])
    counts = {state: sum(card.state == state for card in cards) for state in STATES}
    meanings = dict.fromkeys(tile.meaning for card in cards for tile in card.figures)
    template = templates().get_template("campaign.html.j2")
    return template.render(
        title=title,
        cards=[_plain(card) for card in cards],
        counts=counts,
        states=STATES,
        meanings=list(meanings),
        version=version,
    )


def _plain(card: SceneCard) -> dict[str, Any]:
    """A card as the page's script reads it. A figure's meaning is cut at its first comma or semicolon."""
    figures = [
        {
            "value": tile.value,
            "text": f"{figure(tile.value)} {tile.unit}".strip(),
            "short": re.split("[,;] ", tile.meaning)[0],
            "meaning": tile.meaning,
        }
        for tile in card.figures
    ]
    return {**vars(card), "called": STATES[card.state], "figures": figures}
