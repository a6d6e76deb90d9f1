"""The text of reports, from the templates in this folder."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import jinja2


@cache
def templates(page: bool) -> jinja2.Environment:
    """The templates of this folder; those of a page escape their values."""
    loader = jinja2.PackageLoader("dejavu_torch", "evaluation")
    environment = jinja2.Environment(loader=loader, autoescape=page, trim_blocks=page, lstrip_blocks=page)
    environment.filters |= {"sentence": _sentence, "percent": _percent}
    return environment


def sentences(template: str, **facts: Any) -> str:
    """A template filled with facts, as plain text of one line."""
    text = templates(page=False).get_template(template).render(facts)
    return re.sub(r"[ \n]+", " ", text).strip()


def _sentence(text: str) -> str:
    """Words as a sentence; "" stays empty."""
    return text[:1].upper() + text[1:] + "." * (text[-1:] not in ("", "?"))


def _percent(share: float) -> str:
    """A share as a percentage that does not break over lines."""
    return f"{100 * share:.1f}\xa0%"
