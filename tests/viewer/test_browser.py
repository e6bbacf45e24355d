"""`play --viewer web` in a real browser: a trained cartpole moves, is paused, and gets another policy."""

import io
import re
import time
from contextlib import contextmanager

import numpy as np
import pytest
from support.chromium import CHROMIUM, FLAGS
from support.viewer_process import Playing

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine"),
]
SCENE = {"x": 215, "y": 30, "width": 425, "height": 330}
"""Part of the page that shows only the simulation [pixels]."""
PATIENCE = 240.0
"""Longest time in which a page that is drawn without a GPU must change [s]."""


@contextmanager
def page_of(url, width=640, height=400):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.requested = []
            page.on("request", lambda request: page.requested.append(request.url))
            page.goto(url)
            yield page
        finally:
            browser.close()


def picture(page, part=SCENE):
    from PIL import Image

    shot = page.screenshot(clip=part, timeout=120_000)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def until(what, condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"not seen: {what}"


def press(page, key, what, condition):
    """Hold a key down until its effect is visible: without a GPU a frame may take seconds. The key does not repeat."""
    page.keyboard.down(key)
    until(what, condition)
    page.keyboard.up(key)
    time.sleep(3.0)


def differ(one, other):
    """Return whether two pictures differ by more than the renderer's dithering."""
    return np.abs(one - other).max() > 20


def moves(page):
    first = picture(page)
    time.sleep(1.0)
    return differ(first, picture(page))


def stands_still(page):
    """Return whether the picture stays the same for longer than an episode; a reset would change it."""
    pictures = [picture(page)]
    for _ in range(4):
        time.sleep(2.0)
        pictures.append(picture(page))
    return not any(differ(pictures[0], other) for other in pictures[1:])


def pole(page):
    """Return the pixels of the pole, which is orange."""
    seen = picture(page)
    return (seen[..., 0] > 90) & (seen[..., 0] - seen[..., 2] > 60)


def test_browser_shows_pauses_and_switches_policy(cartpole_run):
    with Playing("--checkpoint", cartpole_run, "--viewer", "web", "--port", 0) as playing:
        with page_of(playing.url) as page:
            until("the pole", lambda: pole(page).sum() > 20)
            assert picture(page).std() > 5
            until("a movement", lambda: moves(page))

            press(page, "Space", "a pause", lambda: stands_still(page))

            steps = sorted(int(folder.name) for folder in (cartpole_run / "checkpoints").glob("0*"))
            press(page, "PageDown", "another policy", lambda: f"now playing step {steps[-2]}" in playing.err)
            until("that it still stands", lambda: stands_still(page))
            press(page, "Space", "a movement again", lambda: moves(page))

            hosts = {re.match(r"\w+://([^/]+)/", url)[1] for url in page.requested if not url.startswith("blob:")}
            assert hosts == {playing.host}
        assert playing.interrupt() == 130
    assert playing.out == ""
    assert "Traceback" not in playing.err
    assert not playing.answers()


def test_panel_is_below_the_scene_on_a_narrow_page(cartpole_run):
    left = {"x": 0, "y": 60, "width": 190, "height": 300}
    below = {"x": 0, "y": 700, "width": 390, "height": 100}

    def panel_is_below():
        return np.median(picture(page, left)) < 200 < np.median(picture(page, below))  # the panel is light

    with (
        Playing("--checkpoint", cartpole_run, "--viewer", "web", "--port", 0) as playing,
        page_of(playing.url, 390, 844) as page,
    ):
        until("the panel below the scene", panel_is_below)
