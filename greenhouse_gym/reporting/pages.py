"""Pages of HTML that open anywhere, without a network; every value that a template receives is escaped."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from greenhouse_gym import __version__


def render(template: str, **values: Any) -> str:
    """Fill one of the package's templates with values; only those marked as safe keep their markup."""
    return _environment().get_template(template).render(values)


@lru_cache(maxsize=1)
def _environment() -> Environment:
    loader = PackageLoader("greenhouse_gym.reporting")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["version"] = __version__
    return environment
