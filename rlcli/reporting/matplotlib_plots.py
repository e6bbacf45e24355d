"""Plot learning curves and the trials of a sweep with matplotlib, as the bytes of picture files.

Equal curves give equal bytes, so that files can be compared. No window is opened.
"""

import importlib.util
import io
import math
import re
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rlcli.errors import DependencyError, pip_install
from rlcli.reporting.curve_panels import Item, Panel
from rlcli.safe_text import UNSAFE, shorten

FORMATS = (".png", ".svg", ".pdf")

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#777777")
"""Colours of lines: the palette of Okabe and Ito, which colour-blind people can distinguish, and two more colours."""
_STYLES = ("-", "--", ":", "-.")
"""Line styles; the next one is used each time the colours are used up."""

INK, FAINT, PAPER = "#1b1f24", "#d0d7de", "#fefefe"
"""Colours of text, grid lines and the background of a legend, as in `curves.mplstyle`; an HTML page replaces them."""
_WIDTH, _HEIGHT = 5.2, 3.2
"""Size of a panel [inches]."""
_PAGE_SIZE = (4.1, 2.7)
"""Size of a panel on an HTML page [inches]. The page scales it up, so its text becomes larger."""
_ONE_COLUMN = 8
"""Largest number of entries in a legend with one column; a longer legend has two."""
_MAX_LABEL = 64
"""Largest length of a label [characters]."""
_MAX_LINES = 3
"""Largest number of lines of a label in a legend."""
_NOT_DRAWN = re.compile(f"{UNSAFE.pattern}|[\t\n\ufffe\uffff]")
"""Characters that a picture cannot show, and characters that change the direction of text; `?` replaces them."""

_STYLE = Path(__file__).resolve().parent.parent / "templates" / "report" / "curves.mplstyle"


def check_drawing() -> None:
    """Check that matplotlib is installed, without importing it.

    Raises:
        DependencyError: if matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise DependencyError("matplotlib is not installed", hint=pip_install("rlcli[plot]"))


def picture(panels: Sequence[Panel], x_label: str, kind: str, *, title: str = "", note: str = "") -> bytes:
    """Return a picture of several panels as the content of a file.

    Args:
        panels: the panels.
        x_label: label of the x axis of each panel.
        kind: file format, one of `FORMATS`.
        title: text above the panels.
        note: text below the panels.

    Raises:
        DependencyError: if matplotlib is not installed.
    """
    columns = 1 if len(panels) == 1 else 2 if len(panels) <= 4 else 3
    rows = math.ceil(len(panels) / columns)
    shared = next((panel.items for panel in panels if panel.by_curve and len(panel.items) > 1), [])
    with _drawing({"svg.fonttype": "path"}):
        figure = _figure((columns * _WIDTH, rows * _HEIGHT + 0.8))
        for position, panel in enumerate(panels, start=1):
            _draw(figure.add_subplot(rows, columns, position), panel, x_label, legend=not (shared and panel.by_curve))
        if title:
            figure.suptitle(_text(title), x=0.01, ha="left", fontweight="bold", fontsize=12)
        if shared:
            most = max((panel.items for panel in panels if panel.by_curve), key=len)
            _legend(figure, most, loc="outside upper right", ncols=min(2, len(most)))
        if note:
            figure.supxlabel(_text(note, 400), x=0.01, ha="left", fontsize=7.5)
        return _bytes(figure, kind)


def scatter(
    columns: Sequence[tuple[str, Sequence[Any], bool]], values: Sequence[float], label: str, *, title: str
) -> bytes:
    """Return a scatter plot for each varied setting of a sweep, with the results of the trials, as SVG.

    Args:
        columns: (name, value of each trial, whether the x axis is logarithmic) of each setting; values that are not
            numbers are plotted at equal distances.
        values: the result of each trial.
        label: name of the result.
        title: title of the picture.
    """
    width = min(3, len(columns))
    rows = math.ceil(len(columns) / width)
    with _drawing({}):
        figure = _figure((_WIDTH * width * 0.75, _HEIGHT * rows * 0.85))
        for position, (name, settings, log) in enumerate(columns):
            axes = figure.add_subplot(rows, width, position + 1)
            is_numeric = all(type(value) in (int, float) for value in settings)
            words = sorted({str(value) for value in settings})
            x = settings if is_numeric else [words.index(str(value)) for value in settings]
            axes.scatter(x, values, s=18.0, color=COLORS[0], alpha=0.8, linewidths=0.0)
            if log:
                axes.set_xscale("log")
            if not is_numeric:
                axes.set_xticks(range(len(words)), [_text(word, 16) for word in words])
            axes.set_xlabel(_text(name))
            if position % width == 0:
                axes.set_ylabel(_text(label))
        figure.suptitle(_text(title))
        return _bytes(figure, ".svg")


def panel_svg(panel: Panel, x_label: str, name: str) -> str:
    """Return a panel without a legend as an SVG element for an HTML page, in the page's colours.

    Args:
        panel: the panel.
        x_label: label of the x axis.
        name: prefix of the ids in the SVG element, unique in the page.
    """
    with _drawing({"svg.fonttype": "none"}):
        figure = _figure(_PAGE_SIZE)
        _draw(figure.add_subplot(), panel, x_label, legend=False, title=False)
        svg = _bytes(figure, ".svg", transparent=True).decode()
    return _for_page(svg, name, f"{panel.title}, {panel.unit}")


def legend_of(panel: Panel) -> list[tuple[str, int, int]]:
    """Return the legend of a panel for an HTML page: label, index of the colour, index of the line style.

    The legend of a single line is empty.
    """
    if panel.by_curve and len(panel.items) == 1:
        return []
    return [(item.label, *_look(item)) for item in panel.items]


@contextmanager
def _drawing(settings: dict[str, Any]) -> Iterator[None]:
    check_drawing()
    import matplotlib as mpl

    # matplotlib warns that it draws a box for a letter that the font lacks
    with mpl.rc_context(), warnings.catch_warnings(action="ignore"):
        mpl.rcdefaults()  # without the user's matplotlibrc, so that the picture is the same everywhere
        mpl.rc_file(_STYLE, use_default_template=False)
        mpl.rcParams.update(settings)
        yield


def _figure(size: tuple[float, float]) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw(axes: Any, panel: Panel, x_label: str, *, legend: bool, title: bool = True) -> None:
    draw = _stack if panel.stacked else _lines
    draw(axes, panel.items)
    if panel.share:
        axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel(x_label)
    axes.set_ylabel(panel.unit)
    axes.margins(x=0.01)
    axes.xaxis.set_major_formatter(_compact)
    if title:
        axes.set_title("\n".join(_text(line, 54) for line in (panel.title, panel.subtitle) if line))
    if legend and panel.items and not (panel.by_curve and len(panel.items) == 1):
        many = len(panel.items) > _ONE_COLUMN
        settings = {"loc": "upper left" if panel.stacked else "best", "fontsize": 6 if many else 8, "ncols": 1 + many}
        _legend(axes, panel.items, bands=panel.stacked, **settings)


def _lines(axes: Any, items: Sequence[Item]) -> None:
    for item in items:
        line, color = item.line, _color(item)
        marker = "o" if len(line.x) == 1 else ""
        axes.plot(line.x, line.middle, color=color, linestyle=_style(item), marker=marker, markersize=4)
        if line.low is not None and line.high is not None:
            axes.fill_between(line.x, line.low, line.high, color=color, alpha=0.2, linewidth=0)


def _stack(axes: Any, items: Sequence[Item]) -> None:
    """Plot shares of episodes as stacked bands.

    Where the shares add up to more than 1, because some episodes ended by several terminations, they are scaled to 1.
    """
    if not items:
        return
    grid = max((item.line.x for item in items), key=len)
    shares = np.stack([np.interp(grid, item.line.x, item.line.middle, left=0.0) for item in items])
    shares = shares / np.maximum(1.0, shares.sum(axis=0))
    axes.stackplot(grid, shares, colors=[_color(item) for item in items], alpha=0.75, linewidth=0)


def _legend(owner: Any, items: Sequence[Item], *, bands: bool = False, **settings: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(color=_color(item), alpha=0.75) if bands else Line2D([], [], color=_color(item), linestyle=_style(item))
        for item in items
    ]
    owner.legend(handles, [_legend_text(item.label) for item in items], **settings)


def _legend_text(label: str) -> str:
    """Return a label for a legend, on up to three lines: labels of two runs may differ only at the end."""
    text = textwrap.fill(_text(label, _MAX_LINES * _MAX_LABEL), _MAX_LABEL, max_lines=_MAX_LINES, placeholder=" …")
    return f" {text}" if text.startswith("_") else text  # matplotlib leaves out labels that begin with an underscore


def _bytes(figure: Any, kind: str, *, transparent: bool = False) -> bytes:
    omitted = {  # dates and versions would change the bytes
        ".svg": {"Date": None, "Creator": None, "Format": None, "Type": None},
        ".png": {"Software": None},
        ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    }
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind[1:], metadata=omitted[kind], transparent=transparent, dpi=130)
    return buffer.getvalue()


def _compact(value: float, _: int | None = None) -> str:
    """Format a tick label: 1500000 -> 1.5M."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def _look(item: Item) -> tuple[int, int]:
    """Return the indices of an item's colour and line style in the lists of this module."""
    return item.index % len(COLORS), item.index // len(COLORS) % len(_STYLES)


def _color(item: Item) -> str:
    return COLORS[_look(item)[0]]


def _style(item: Item) -> str:
    return _STYLES[_look(item)[1]]


def _text(text: str, limit: int = _MAX_LABEL) -> str:
    return shorten(_NOT_DRAWN.sub("?", text), limit, "…")


def _for_page(svg: str, name: str, label: str) -> str:
    """Convert matplotlib's SVG for an HTML page: no fixed size, ids that begin with `name`, the page's colours.

    `label` describes the picture to a screen reader.
    """
    head, _, rest = svg[svg.index("<svg") :].partition(">")
    view_box = re.search(r'viewBox="[\d. ]+"', head)
    assert view_box is not None
    rest = re.sub(r"<metadata>.*?</metadata>|<defs>\s*<style.*?</style>\s*</defs>", "", rest, flags=re.DOTALL)
    rest = re.sub(r'(?<= id=")|(?<=url\(#)|(?<=xlink:href="#)', f"{name}-", rest)
    variables = {INK: "currentColor", FAINT: "var(--rule)", PAPER: "var(--paper)"}
    for color, variable in {**variables, **{color: f"var(--c{i})" for i, color in enumerate(COLORS)}}.items():
        rest = rest.replace(color, variable)
    rest = rest.replace("'DejaVu Sans'", "inherit")
    return f'<svg {view_box[0]} role="img" aria-label="{escape(label)}">{rest}'.strip()
