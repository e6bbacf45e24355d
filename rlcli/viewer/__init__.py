"""Viewers that show environments in a window or in the browser, and videos that are rendered without a window."""
