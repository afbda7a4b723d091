"""A self-contained HTML page: pictures, data and script are inside, nothing is loaded."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.reports.explorer import Explorer, StoredExplorer, style
from torchrl_bmrl.reports.tables import Table

with needs("reports"):
    from jinja2 import Environment, StrictUndefined

_TEMPLATE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light">
{# The browser refuses to load anything from elsewhere. #}
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>{{ title }}</title>
<style>
  body { margin: 2.5rem auto; max-width: 74rem; padding: 0 1.25rem; color: #1d2129;
         background: #fff; font: 16px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
  h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 1.25rem; }
  h2 { font-size: 1.3rem; margin: 3rem 0 .5rem; padding-bottom: .3rem;
       border-bottom: 1px solid #d6dae0; }
  h3 { font-size: 1rem; margin: 0 0 .5rem; }
  p { max-width: 46rem; }
  dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.25rem;
       background: #f5f6f8; border-radius: 6px; margin: 0; padding: .9rem 1.1rem; }
  dt { color: #5a6270; }
  dd { margin: 0; overflow-wrap: anywhere; }
  figure { margin: 1.75rem 0; }
  figcaption { max-width: 46rem; margin-top: .6rem; color: #5a6270; font-size: .875rem; }
  img { display: block; max-width: 100%; height: auto; }
  .wide { overflow-x: auto; }
  table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
  th, td { padding: .3rem .45rem; text-align: left; white-space: nowrap; }
  th { border-bottom: 2px solid #1d2129; vertical-align: bottom; white-space: normal; }
  td { border-bottom: 1px solid #e4e7eb; }
  .number { text-align: right; }
{{ style | safe }}</style>
</head>
<body>
<h1>{{ title }}</h1>
{% if facts %}
<dl>
{% for name, value in facts.items() %}
<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
{% endif %}
{% for section in sections %}
<section>
<h2>{{ section.heading }}</h2>
{% for paragraph in section.paragraphs %}
<p>{{ paragraph }}</p>
{% endfor %}
{% for table in section.tables %}
{{ table.html() | safe }}
{% endfor %}
{% if section.explorer %}
{{ section.explorer.html() | safe }}
{% endif %}
{% for picture in section.pictures %}
<figure>
<img src="data:image/png;base64,{{ picture.base64() }}" alt="{{ picture.alt }}">
<figcaption>{{ picture.caption }}</figcaption>
</figure>
{% endfor %}
</section>
{% endfor %}
</body>
</html>
"""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of the page.

    Args:
        png: PNG image.
        alt: Description for readers who cannot see it.
        caption: Caption.

    Example:
        >>> Picture(png=b"abc", alt="", caption="").base64()
        'YWJj'
    """

    png: bytes
    alt: str
    caption: str

    def base64(self) -> str:
        """Returns the image as base64 text, for a data URI."""
        return base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page: heading, text, tables, explorer and pictures, in this order.

    Args:
        heading: Heading.
        paragraphs: Text.
        tables: Tables.
        explorer: Explorer of the embedding.
        pictures: Pictures.

    Example:
        >>> table = Table(title="T", caption="C", header=("Task",), rows=[("Lift",)])
        >>> section = Section(heading="Results", paragraphs=["All of them."], tables=[table])
        >>> len(section.tables), section.explorer
        (1, None)
    """

    heading: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    explorer: Explorer | StoredExplorer | None = None
    pictures: Sequence[Picture] = ()


def write_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    facts: Mapping[str, str],
    sections: Sequence[Section],
) -> None:
    """Writes a self-contained HTML page atomically.

    Args:
        path: The file to write or replace.
        title: Title and first heading.
        facts: Names and values for the box at the top, such as seed and versions.
        sections: Parts of the page. All text is escaped.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "report.html"
        >>> write_page(path, title="A run", facts={"seed": "0"}, sections=[])
        >>> "<h1>A run</h1>" in path.read_text()
        True
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(_TEMPLATE)
    css = style() if any(section.explorer for section in sections) else ""
    page = template.render(title=title, facts=facts, sections=sections, style=css)
    write_atomic(path, page)
