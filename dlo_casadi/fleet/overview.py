"""The page of a fleet: one row per session, the odd ones first. Self-contained, no script."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from dlo_casadi import __version__
from dlo_casadi.errors import counted
from dlo_casadi.fleet.columns import Row, last_error
from dlo_casadi.fleet.outliers import OUTLYING, Judged, judge

STYLE = """
:root { color-scheme: light dark; --line: #8884; --odd: #c0392b; --good: #2c7a4b; }
body { font: 15px/1.45 system-ui, sans-serif; }
body { margin: 2rem auto; max-width: 80rem; padding: 0 1rem; }
h1 { font-size: 1.4rem; margin: 0 0 .3rem; } p { margin: .3rem 0 1rem; max-width: 60rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid var(--line); }
td { white-space: nowrap; vertical-align: top; } th { vertical-align: bottom; }
.text { text-align: left; } .long { white-space: normal; min-width: 11rem; }
.odd { color: var(--odd); font-weight: 600; } .good { color: var(--good); }
pre { white-space: pre-wrap; margin: 0; font: inherit; }
"""

# Of a session whose diagnosis was switched off.
UNDIAGNOSED = "not diagnosed"

HEAD = (
    ("session", "text"),
    ("verdict", "text"),
    ("what is odd", "text"),
    ("EI [N m²]", ""),
    ("95 %", ""),
    ("z of EI", ""),
    ("error [mm]", ""),
    ("z of error", ""),
    ("noise std [mm]", ""),
    ("effects", "text"),
    ("time [s]", ""),
)


def overview_html(rows: Sequence[Row], output: Path) -> str:
    """The page as text.

    Parameters
    ----------
    rows : sequence of dict
    output : Path
        Folder in which the page will lie; sessions with results in it are linked.
    """
    judged = judge(rows)
    head = "".join(f'<th class="{kind}">{escape(text)}</th>' for text, kind in HEAD)
    body = "\n".join(_line(item, output) for item in judged)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{counted(len(rows), 'session')}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{counted(len(rows), 'session')}</h1>\n<p>{escape(_summary(judged))}</p>\n"
        f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table></div>\n"
        "<p>Error: root mean square distance of the measured centre-lines from the prediction of "
        "the last stage, of held-out poses where there are any. z: distance from the median of "
        "all sessions, on a logarithmic scale, in robust standard deviations; beyond "
        f"{OUTLYING:g} it is called an outlier. All numbers: table.parquet.</p>\n"
        f"<p>dlo_casadi {escape(__version__)}</p>\n</body>\n</html>\n"
    )


def _summary(judged: Sequence[Judged]) -> str:
    verdicts = Counter(
        item.row["verdict"] or UNDIAGNOSED if item.row["status"] == "done" else item.row["status"]
        for item in judged
    )
    counts = ", ".join(f"{n} {str(name).replace('_', ' ')}" for name, n in verdicts.most_common())
    odd = sum(bool(item.reasons) for item in judged)
    return f"{counts or 'nothing is finished yet'}. {odd} to look at first."


def _line(item: Judged, output: Path) -> str:
    row = item.row
    name = _link(row, output)
    odd = f'<span class="odd">{escape(", ".join(item.reasons))}</span>' if item.reasons else ""
    if row["status"] != "done":
        text = f'<pre class="odd">{escape(str(row["message"]))}</pre>'
        return (
            f'<tr><td class="text long">{name}</td><td></td><td class="text">{odd}</td>'
            f'<td class="text long" colspan="{len(HEAD) - 3}">{text}</td></tr>'
        )
    verdict = str(row["verdict"] or UNDIAGNOSED)
    error = last_error(row)
    cells = (
        ("text long", name),
        ("text good" if verdict == "complete" else "text", escape(verdict.replace("_", " "))),
        ("text", odd),
        ("", _number(row["bending_stiffness"], "{:.4g}")),
        ("", _interval(row)),
        (_score(item.stiffness_z), _number(item.stiffness_z, "{:+z.1f}")),
        ("", _number(error, "{:.2f}", 1e3)),
        (_score(max(item.error_z or 0.0, 0.0)), _number(item.error_z, "{:+z.1f}")),
        ("", _number(row["noise_std"], "{:.2f}", 1e3)),
        ("text long", escape(", ".join(_effect(effect) for effect in row["effects"]))),
        ("", _number(row["time_session_s"], "{:.1f}")),
    )
    return "<tr>" + "".join(f'<td class="{kind}">{text}</td>' for kind, text in cells) + "</tr>"


def _link(row: Row, output: Path) -> str:
    """The session's page: of its results, or of why there are none."""
    key = str(row["session"])
    text = escape(key).replace("/", "/<wbr>")
    for name in ("report.html", "report.json") if row["status"] == "done" else ("failed.html",):
        if (output / "sessions" / key / name).is_file():
            return f'<a href="{quote(f"sessions/{key}/{name}")}">{text}</a>'
    return text


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "" if value is None else form.format(factor * value)


def _interval(row: Row) -> str:
    if not row["identifiable"]:
        return '<span class="odd">not determined</span>'
    low, high = row["bending_stiffness_low_95"], row["bending_stiffness_high_95"]
    return f"{_number(low, '{:.4g}')} to {_number(high, '{:.4g}')}"


def _score(z: float | None) -> str:
    return "odd" if z is not None and abs(z) > OUTLYING else ""


def _effect(effect: Row) -> str:
    """Name of an effect, and of what it cannot be told from."""
    rivals = effect["indistinguishable_from"]
    return str(effect["name"]) + (f" (or {', '.join(rivals)})" if rivals else "")
