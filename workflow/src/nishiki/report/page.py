"""The page itself: the template filled in. The same content gives the same bytes."""

from typing import Any

from nishiki.report.numbers import plain

TEMPLATE = "page.html.j2"
OBJECT_TEMPLATE = "object.html.j2"


def render_page(content: dict[str, Any], template: str = TEMPLATE) -> str:
    """HTML of a page. content : what the template names; a missing name is an error, not an empty place."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("nishiki.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": figure, "percent": percent, "degrees": degrees, "signed": signed}
    return environment.get_template(template).render(content)


def percent(value: float | None) -> str:
    """A share in per cent, to a hundredth."""
    if value is None:
        return "–"
    if 0 < value < 0.01:
        return "< 0.01\u202f%"
    return f"{value:.2f}\u202f%" if value else "0"


def signed(share: float | None) -> str:
    """A share in per cent with its sign, to a tenth."""
    if share is None:
        return "–"
    tenths = round(1000 * share)
    return f"{tenths / 10:+.1f}\u202f%".replace("-", "−") if tenths else "0\u202f%"


def degrees(value: float | None) -> str:
    """An angle to a degree, with a true minus and without a negative zero."""
    return "–" if value is None else f"{round(value):d}°".replace("-", "−")


def figure(value: Any, digits: int = 3, unit: str = "") -> str:
    """A measured figure as text: `digits` significant ones, a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, int):
        digits = max(digits, len(str(abs(value))))
        return plain(value, digits) + (f"\u202f{unit}" if unit else "")
    return plain(value, digits, padded=True) + (f"\u202f{unit}" if unit else "")
