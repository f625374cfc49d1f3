"""Stretch of a drive that each method needs."""

from services.finding.crossing_data import WindowOf, close_window, wide_window


def window_of(method: str) -> WindowOf:
    """Return the shape of a method's window; the paper's methods need the bridge alone."""
    return wide_window if method == "pre" else close_window
