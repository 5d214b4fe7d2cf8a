"""The page of a sweep: the template filled in."""

from typing import Any

TEMPLATE = "sweep.html.j2"


def render_sweep(content: dict[str, Any]) -> str:
    """HTML of the page, in the look of the reports. content : as `content.sweep_content` makes it."""
    import jinja2

    from nishiki.report.page import figure

    loader = jinja2.ChoiceLoader(
        [jinja2.PackageLoader("nishiki.sweep", "."), jinja2.PackageLoader("nishiki.report", ".")]
    )
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"figure": figure}
    return environment.get_template(TEMPLATE).render(content)
