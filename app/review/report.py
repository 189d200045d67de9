"""A page of what Review shows, in one HTML file that needs nothing beside it."""

from __future__ import annotations

import csv
import io
from base64 import b64encode
from html import escape
from pathlib import Path

from backend.core.files import write_atomically

STYLE = """
body { font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 1200px; padding: 0 1em; }
img { max-width: 100%; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #bbb; padding: 3px 10px; text-align: left; }
"""


def report_of(caption: str, facts: str, picture: bytes, table: str) -> str:
    """Return the page: ``caption``, ``facts`` line by line, a PNG, and a table given as CSV."""
    rows = list(csv.reader(io.StringIO(table)))
    head = "".join(f"<th>{escape(name)}</th>" for name in rows[0])
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in rows[1:]
    )
    said = "<br>\n".join(escape(line) for line in facts.splitlines())
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head><meta charset="utf-8">'
        f"<title>{escape(caption)}</title><style>{STYLE}</style></head>\n<body>\n"
        f"<h1>{escape(caption)}</h1>\n<p>{said}</p>\n"
        f'<img alt="{escape(caption)}" src="data:image/png;base64,{b64encode(picture).decode()}">\n'
        f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>\n"
        "</body>\n</html>\n"
    )


def export_report(text: str, folder: Path, name: str) -> Path:
    """Write a page; raises ``OSError``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.html"
    write_atomically(path, text.encode())
    return path
