"""Viewers of environments (a native window, the browser), and videos rendered without a window."""
