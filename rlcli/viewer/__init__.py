"""Viewers of environments (a native window, the browser), and offscreen videos."""
