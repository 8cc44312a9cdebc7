"""The page: what HTML the report is made of. Prose and heads of tables are in `report.html`."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import cache
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote
from xml.etree import ElementTree

if TYPE_CHECKING:
    from turgor.experiments.sheets import Figure

SVG, XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
Cells = dict[str, Any]  # one row of a table, by field


class Column(NamedTuple):
    """A column of a table."""

    field: str
    form: str  # of its numbers, as in ".2f"; "p": a p-value; empty: text
    head: str  # HTML
    group: str  # heading over neighbours that share it; empty: none


@cache
def parts_of_page() -> dict[str, Template]:
    """The parts of `report.html` by name."""
    text = Path(__file__).with_name("report.html").read_text(encoding="utf-8")
    names, parts = re.findall(r"<!-- ([\w-]+) -->", text), re.split(r"<!-- [\w-]+ -->\n", text)[1:]
    return {name: Template(part.rstrip() + "\n") for name, part in zip(names, parts, strict=True)}


def prose(part: str, **words: str) -> str:
    """A part of `report.html`, with HTML in the place of its $words."""
    return parts_of_page()[part].substitute(words)


def make_table(part: str, rows: Sequence[Cells], question: str = "", heads: int = 2, **words: str) -> str:
    """The table whose caption and columns are a part of `report.html`, without columns in which no row has anything.

    The first `heads` columns name a row.
    """
    if not rows:
        return ""
    caption, _, spec = prose(f"table-{part}", **words).partition("\n")
    columns = [c for c in read_columns(spec) if any(row.get(c.field) is not None for row in rows)]
    name = f"{question}-{part}" if question else part
    upper, lower = "", ""
    for group, members in groupby(columns, key=lambda column: column.group):
        found = list(members)
        deep = "" if group else ' rowspan="2"'
        cells = "".join(f'<th scope="col"{deep}{alignment(column)}>{column.head}</th>' for column in found)
        upper += f'<th scope="colgroup" colspan="{len(found)}">{group}</th>' if group else cells
        lower += cells if group else ""
    if not lower:
        upper = upper.replace(' rowspan="2"', "")
    body, before = "", None
    for row in rows:
        first = row[columns[0].field]
        body += '<tr class="next">' if heads > 1 and before not in (None, first) else "<tr>"
        body += (
            "".join(make_cell(column, row.get(column.field), k < heads) for k, column in enumerate(columns)) + "</tr>\n"
        )
        before = first
    return f"""<div class="scroll" role="region" tabindex="0" aria-labelledby="caption-{name}">
<table id="table-{name}">
<caption id="caption-{name}"><span>{caption}</span></caption>
<thead><tr>{upper}</tr>{f"<tr>{lower}</tr>" if lower else ""}</thead>
<tbody>
{body}</tbody>
</table>
</div>
"""


def folded(summary: str, content: str) -> str:
    return f"<details>\n<summary>{summary}</summary>\n{content}</details>\n" if content else ""


def read_columns(spec: str) -> list[Column]:
    """The columns told by lines of `field:form heading`, or of `group | field:form heading | ...`."""
    columns = []
    for line in spec.strip().splitlines():
        parts = [part.strip() for part in line.split("|")]
        group = parts.pop(0) if len(parts) > 1 else ""
        for part in parts:
            name, _, head = part.partition(" ")
            field, _, form = name.partition(":")
            columns.append(Column(field, form, head, group))
    return columns


def make_cell(column: Column, value: Any, head: bool) -> str:
    raw = "" if value is None else str(value)  # as in the CSV file
    if value is None:
        text = '<span aria-label="none">–</span>'
    elif isinstance(value, bool):
        text = "yes" if value else "no"
    else:
        text = escape(in_digits(value, column.form) if column.form else raw)
    tag = 'th scope="row"' if head else "td"
    return f'<{tag}{alignment(column)} data-field="{column.field}" data-value="{escape(raw)}">{text}</{tag[:2]}>'


def alignment(column: Column) -> str:
    return ' class="number"' if column.form else ""


def inline_svg(path: Path, figure: Figure) -> str:
    """The SVG file as an element whose ids are its own and whose styles reach nothing else."""
    ElementTree.register_namespace("", SVG)
    ElementTree.register_namespace("xlink", XLINK)
    prefix, scope = f"{figure.name}-", f"#figure-{figure.name} svg"
    root = ElementTree.parse(path).getroot()
    for element in list(root.iter()):
        for child in [c for c in element if c.tag == f"{{{SVG}}}metadata"]:
            element.remove(child)
        for name, value in element.attrib.items():
            if name == "id":
                value = prefix + value
            elif name in ("href", f"{{{XLINK}}}href"):
                value = re.sub("^#", f"#{prefix}", value)
            element.set(name, re.sub(r"url\((['\"]?)#", rf"url(\1#{prefix}", value))
        if element.tag == f"{{{SVG}}}style" and element.text:
            element.text = re.sub(r"(^|\})\s*([^{}@]+)\{", rf"\1 {scope} \2{{", element.text)
    for name in ("width", "height"):
        root.attrib.pop(name, None)
    root.set("role", "img")
    root.set("aria-label", figure.title)
    return ElementTree.tostring(root, encoding="unicode")


def first_frame(path: Path) -> tuple[bytes, int, int]:
    """A JPEG picture from the middle of a film, its width and height."""
    import av

    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        film.seek((stream.duration or 0) // 2, stream=stream)
        frame = next(film.decode(stream)).reformat(format="yuvj420p")
    encoder = av.CodecContext.create("mjpeg", "w")
    encoder.width, encoder.height, encoder.pix_fmt = frame.width, frame.height, "yuvj420p"
    encoder.time_base = Fraction(1)
    return b"".join(map(bytes, [*encoder.encode(frame), *encoder.encode(None)])), frame.width, frame.height


def data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def links_to(files: Iterable[Path], folder: Path) -> list[str]:
    """Links to those of `files` that lie beneath `folder`."""
    near = [file for file in files if file.is_file() and file.resolve().is_relative_to(folder.resolve())]
    paths = [file.resolve().relative_to(folder.resolve()).as_posix() for file in near]
    return [f'<a href="{quote(path)}">{escape(Path(path).suffix[1:].upper())}</a>' for path in paths]


def in_digits(value: float, form: str) -> str:
    if form == "p":
        return "< 0.0001" if value < 0.0001 else f"{value:.4f}"
    text = format(value, f"z{form}" if isinstance(value, float) else form)
    return text.replace("-", "−")


def told_facts(facts: dict[str, Any]) -> str:
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(in_words(fact))}</dd>\n" for name, fact in facts.items())
    return f"<dl>\n{items}</dl>\n" if items else ""


def in_words(fact: Any, between: str = ", ") -> str:
    return between.join(map(str, fact)) if isinstance(fact, list | tuple) else str(fact)


def in_minutes(seconds: float) -> str:
    return f"{seconds / 60:,.1f} min" if seconds >= 60 else f"{seconds:.1f} s"


def counted(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def each_of(values: dict[str, float]) -> str:
    """As in "0.94 (small) and 0.91 (large)"."""
    return listed(f"{in_digits(value, '.2f')} ({escape(body)})" for body, value in values.items())


def listed(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
