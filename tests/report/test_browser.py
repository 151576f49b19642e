"""The page in a headless browser: no error, the robot moves, and it looks as before.

Pictures are compared coarsely, because every machine renders text and shades a little differently. After a wanted
change of looks, look at the new picture and replace the golden one:
`FORCEGP_NEW_GOLDENS=1 make test-browser`.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

GOLDENS = Path(__file__).parent / "goldens"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in BROWSERS if (found := shutil.which(name))), None)
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
COARSE = (60, 50)  # pixels to which pictures are averaged
ALIKE = 8.0  # largest mean difference of two pictures that look alike, of 255


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make test-browser")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory, page):
    from forcegp.report import write_page

    path = tmp_path_factory.mktemp("browser") / "report.html"
    write_page(path, page)
    return path


def opened(browser, path):
    """The page without network, and what its console complains of."""
    page, complaints = browser.new_context(viewport={"width": 1200, "height": 1000}, offline=True).new_page(), []
    page.set_default_timeout(300_000)  # ms: without a GPU, on a busy machine, a picture takes more than the usual 30 s
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(path.as_uri())
    page.frame_locator("iframe").locator("canvas").first.wait_for()
    page.wait_for_timeout(4_000)
    return page, complaints


def picture(page, place):
    """What the page shows, in grey and coarse."""
    page.screenshot(path=place, full_page=True)
    return np.asarray(Image.open(place).convert("L").resize(COARSE, Image.Resampling.BOX), dtype=float)


def test_the_page_opens_without_network_looks_as_before_and_the_robot_moves(browser, report, tmp_path):
    page, complaints = opened(browser, report)
    frame = page.frame_locator("iframe").locator("canvas").first
    found, seen = picture(page, tmp_path / "page.png"), []
    for number in range(3):
        frame.screenshot(path=tmp_path / f"{number}.png")
        seen.append(np.asarray(Image.open(tmp_path / f"{number}.png").convert("L"), dtype=float))
        page.wait_for_timeout(1_200)
    assert not complaints
    assert max(np.abs(seen[0] - seen[1]).max(), np.abs(seen[1] - seen[2]).max()) > 50.0
    if os.environ.get("FORCEGP_NEW_GOLDENS"):
        Image.fromarray(found.astype(np.uint8)).save(GOLDENS / "report.png")
    golden = np.asarray(Image.open(GOLDENS / "report.png").convert("L"), dtype=float)
    assert np.abs(found - golden).mean() < ALIKE
    page.evaluate("document.querySelectorAll('figure').forEach(each => each.remove())")
    assert np.abs(picture(page, tmp_path / "without.png") - golden).mean() > ALIKE  # the comparison can fail
