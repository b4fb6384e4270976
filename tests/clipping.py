"""Texts that reach out of a figure, which a reader would see cut off."""

from matplotlib.figure import Figure
from matplotlib.text import Text


def clipped(figure: Figure) -> list[str]:
    """Texts that reach out of the figure."""
    figure.draw_without_rendering()
    frame = figure.bbox.padded(1.0)
    hidden = {id(text) for axes in figure.axes for text in _not_drawn(axes)}
    found = []
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and id(text) not in hidden:
            box = text.get_window_extent()
            inside_x = frame.x0 <= box.x0 and box.x1 <= frame.x1
            inside_y = frame.y0 <= box.y0 and box.y1 <= frame.y1
            found += [] if inside_x and inside_y else [text.get_text()]
    return found


def _not_drawn(axes):
    """Tick labels of axes that are switched off, and of ticks outside the limits."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks():
            if not axes.axison or not low <= tick.get_loc() <= high:
                yield tick.label1
                yield tick.label2
