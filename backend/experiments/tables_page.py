"""A report as one page of HTML that needs nothing beside it."""

from __future__ import annotations

from html import escape

from backend.experiments.document import Entry, Gallery, Grid, Picture, Report, Section

STYLE = """
body{font:15px/1.45 'DejaVu Sans',system-ui,sans-serif;color:#1B2127;background:#F2F4F6;
margin:2em auto;max-width:1180px;padding:0 1em}
h1{font-size:1.5em}h2{font-size:1.2em;margin:2em 0 .3em}h3{font-size:1em;margin:1.2em 0 .2em}
.banner{background:#F9C800;color:#14181C;padding:.35em .8em;display:inline-block;font-weight:600}
.wide{overflow-x:auto}.strip,.charts{display:flex;gap:14px;flex-wrap:wrap}
.charts svg{background:#fff;border:1px solid #C9D0D7}
.probe{background:#fff;border:1px solid #C9D0D7;padding:10px;width:232px}
.probe p{margin:.4em 0;font-size:.85em}.end{font-weight:600}
table{border-collapse:collapse;background:#fff}
th{text-align:left;font-weight:600;white-space:nowrap}td{text-align:right;white-space:nowrap}
td,th{padding:.35em .7em;border-bottom:1px solid #C9D0D7;vertical-align:top}
small{color:#55606B;display:block;font-size:.8em}code{font-size:.85em;overflow-wrap:anywhere}
"""


def tables_page(report: Report) -> str:
    """Return the whole page; hovering over a cell shows its job and seed."""
    about = "".join(f"<p>{escape(text)}</p>" for text in report.about)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head><body>"
        f'<h1>{escape(report.title)}</h1><p class="banner">{escape(report.banner)}</p>{about}'
        f"{''.join(map(_section, report.sections))}</body></html>"
    )


def _section(section: Section) -> str:
    text = "".join(f"<p>{escape(words)}</p>" for words in section.text)
    parts = [_grid(part) if isinstance(part, Grid) else _gallery(part) for part in section.parts]
    return f"<h2>{escape(section.title)}</h2>{text}{''.join(parts)}"


def _grid(grid: Grid) -> str:
    head = "".join(f"<th>{escape(name)}{_small(below)}</th>" for name, below in grid.columns)
    rows = "".join(
        f"<tr><th>{escape(name)}</th>{''.join(map(_cell, entries))}</tr>"
        for name, entries in grid.rows
    )
    note = f"<p>{_small(grid.note)}</p>" if grid.note else ""
    return (
        f'{_title(grid.title)}<div class="wide"><table><tr><th></th>{head}</tr>{rows}</table></div>'
        f"{note}"
    )


def _cell(entry: Entry) -> str:
    trace = f' title="{escape(entry.trace)}"' if entry.jobs else ""
    notes = "".join(map(_small, entry.notes))
    return f"<td{trace}>{escape(entry.value)}{_small(entry.interval)}{notes}</td>"


def _gallery(gallery: Gallery) -> str:
    text = f"<p>{escape(gallery.text)}</p>" if gallery.text else ""
    end = f'<p class="end">{escape(gallery.end)}</p>' if gallery.end else ""
    told = any(picture.title or picture.note for picture in gallery.pictures)
    drawn = "".join(_told(p) if told else p.svg for p in gallery.pictures)
    kind = "strip" if told else "charts"
    return f'{_title(gallery.title)}{text}<div class="{kind}">{drawn}</div>{end}'


def _told(picture: Picture) -> str:
    return (
        f'<div class="probe"><b>{escape(picture.title)}</b>{picture.svg}'
        f"<p>{escape(picture.note)}</p></div>"
    )


def _title(text: str) -> str:
    return f"<h3>{escape(text)}</h3>" if text else ""


def _small(text: str) -> str:
    return f"<small>{escape(text)}</small>" if text else ""
