"""A run's page in a real Chromium without a network: curves and video are visible, and no request is sent."""

import io
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from PIL import Image
from support.written_runs import learning, write_run
from test_run_page_content import ATTACK

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt install chromium"),
    pytest.mark.usefixtures("empty_folder"),
]


@pytest.fixture
def browser():
    """Function that opens a file without a network and records the page's requests and messages."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-quic", "--disable-background-networking"]
        )

        def visit(file, *, offline=True, width=1200, **settings):
            context = chromium.new_context(offline=offline, viewport={"width": width, "height": 900}, **settings)
            page = context.new_page()
            page.requests, page.messages = [], []
            page.on("request", lambda request: page.requests.append(request.url))
            page.on("console", lambda message: page.messages.append(message.text))
            page.on("pageerror", lambda error: page.messages.append(str(error)))
            page.on("dialog", lambda dialog: (page.messages.append("dialog"), dialog.dismiss()))
            page.goto(file.absolute().as_uri())
            return page

        yield visit
        chromium.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Page of a trained run, with an evaluation and a video."""
    from rlcli.cli.app import main

    runs = tmp_path_factory.mktemp("runs")
    train = ["train", "cartpole", "--num-envs", "64", "--max-iterations", "40", "episode_length_s=1.0"]
    assert main([*train, "--logger", "none", "-q", "--runs-dir", str(runs)]) == 0
    (run,) = runs.glob("cartpole/*")
    assert main(["report", str(run), "-q"]) == 0
    return run / "report.html"


def wait(page, condition):
    """Wait for a condition; the browser's own wait function needs an evaluation that the page's policy forbids."""
    for _ in range(300):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(200)
    raise AssertionError(f"{condition} never became true")


def pixels(element):
    with Image.open(io.BytesIO(element.screenshot())) as image:
        return np.asarray(image.convert("RGB"), dtype=float)


def test_page_shows_curves_and_video_without_network(browser, report):
    page = browser(report)
    wait(page, "document.querySelector('video').readyState >= 3")
    charts = page.locator(".charts svg")
    assert charts.count() == 5
    for chart in charts.all():
        chart.scroll_into_view_if_needed()
        picture = pixels(chart)
        assert picture.shape[0] > 150
        assert picture.shape[1] > 250
        blue = (picture[..., 2] > picture[..., 0] + 60).sum()
        assert blue > 100  # the first curve is blue
    assert "Squared joint deviation" in page.inner_text("main")
    film = page.locator("video")
    film.scroll_into_view_if_needed()
    assert film.evaluate("v => [v.videoWidth, v.videoHeight]") == [640, 480]
    assert film.evaluate("v => v.duration") == pytest.approx(1.0, abs=0.05)
    film.evaluate("v => { v.loop = false; return v.play() }")
    wait(page, "document.querySelector('video').currentTime > 0.3")
    middle = pixels(film)[100:-100, 100:-100]
    assert middle.std() > 10  # a picture, and neither black nor white
    assert middle.mean() > 20
    assert [url for url in page.requests if not url.startswith("data:video/mp4;")] == [report.absolute().as_uri()]
    assert page.messages == []


@pytest.mark.parametrize(("scheme", "bright"), [("light", True), ("dark", False)])
def test_page_fits_phone_width_and_colour_scheme(browser, report, scheme, bright):
    page = browser(report, width=390, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    text = page.evaluate("getComputedStyle(document.querySelector('svg text')).fill")
    assert (sum(map(int, background[4:-1].split(","))) > 600) == bright
    assert (sum(map(int, text[4:-1].split(","))) < 200) == bright


def test_print_shows_whole_configuration(browser, report):
    page = browser(report)
    page.emulate_media(media="print")
    closed = page.locator("details:not([open]) td").first
    assert closed.bounding_box()["height"] > 0
    assert not page.locator("nav").is_visible()


@pytest.fixture
def listener():
    """Local server that records its requests."""
    requests = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append(self.path)
            self.send_response(404)
            self.send_header("Content-Length", "0")
            self.send_header("Connection", "close")
            self.end_headers()

        def log_message(self, *_): ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}", requests
    server.shutdown()
    thread.join()
    server.server_close()


def test_untrusted_text_does_not_run(browser, cli, tmp_path):
    rows = learning(**{f"Episode_Reward/{ATTACK}": 1.0})
    run = write_run(tmp_path / "runs", rows=rows, versions={ATTACK: ATTACK}, platform=ATTACK)
    run.update(state=ATTACK)
    folder = run.folder.rename(run.folder.with_name("<img src=x onerror=alert(1)>"))
    assert cli("report", folder).code == 0
    page = browser(folder / "report.html")
    page.wait_for_timeout(500)
    assert page.title() == f"cartpole · {folder.name}"
    assert page.messages == []
    assert page.locator("img, script").count() == 0


def test_injected_markup_is_blocked_by_policy(browser, cli, tmp_path, listener):
    place, requests = listener
    run = write_run(tmp_path / "runs", rows=learning())
    assert cli("report", run.folder, "-o", "page.html").code == 0
    smuggled = (
        f'<img src="{place}/img"><script src="{place}/script"></script><script>document.title = "run"</script>'
        f'<link rel="stylesheet" href="{place}/css"><iframe src="{place}/frame"></iframe><video src="{place}/film" '
        f"autoplay></video><style>@font-face {{font-family: f; src: url({place}/font)}} body {{font-family: f; "
        f'background: url({place}/background)}}</style><svg><image href="{place}/svg" width="9" height="9"/></svg>'
        '<img src="data:x" onerror="document.title = \'run\'">'
    )
    (tmp_path / "smuggled.html").write_text((tmp_path / "page.html").read_text().replace("<main>", f"<main>{smuggled}"))
    (tmp_path / "open.html").write_text(f"<!doctype html>{smuggled}")
    page = browser(tmp_path / "smuggled.html", offline=False)
    page.wait_for_timeout(1000)
    assert requests == []
    assert page.title() != "run"
    page = browser(tmp_path / "open.html", offline=False)  # without the policy all of it would have worked
    wait(page, "document.title === 'run'")
    page.wait_for_timeout(1000)
    assert {"/img", "/script", "/css", "/frame"} <= set(requests)
