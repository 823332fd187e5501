"""Report pages out of templates. Names, licences and origins come from files of others: everything is escaped."""

from __future__ import annotations

from typing import Any


def render(template: str, **values: Any) -> str:
    """The page of `calibrate/templates/<template>`. An undefined name is an error of ours, not an empty place."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("calibrate"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
