"""Reports and the built site in a headless browser: no error, the robot moves, and they look as before.

Pictures are compared coarsely and in one font, because every machine renders text and shades a little differently.
After a wanted change of looks, look at the new pictures and replace the golden ones:
`FORCEGP_NEW_GOLDENS=1 make test-browser`.
"""

import base64
import io
import os
import shutil
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from benchmarks.confusion import Case
from PIL import Image
from tests.posterior.arm import arm_data, arm_model
from tests.report.conftest import QUICK

from forcegp import Contact, JointFriction, Plane, fit, simulation
from forcegp.forces import AerodynamicForce
from forcegp.report import model_page, write_page

GOLDENS, SITE = Path(__file__).parent / "goldens", Path(__file__).parents[2] / "build" / "docs"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in BROWSERS if (found := shutil.which(name))), None)
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FLAGS += ["--blink-settings=imageAnimationPolicy=2"]  # the first picture of each film
FONT = base64.b64encode((Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf").read_bytes()).decode()
STYLE = f"@font-face {{ font-family: F; src: url(data:font/ttf;base64,{FONT}) }} * {{ font-family: F !important }}"
STYLE += ".mantine-Notification-root { display: none }"  # that there is no GPU
COARSE = (64, 48)  # pixels to which pictures are averaged
ALIKE = 0.8  # largest mean difference of two pictures that look alike, of 255; without any part it is 1.3 and more
WALL = Contact("hand", (0.0, 0.0, 0.2), Plane((1.0, 0.0, 0.0), 0.3))
LOGS = {"wall": lambda: arm_data(60, 0, arm_model(0).with_contacts([WALL])), "scara": lambda: Case("scara", 0).log()}
LOGS |= {name: lambda name=name: simulation.simulate(name, seconds=1.0) for name in ("quadrotor", "quadruped")}


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make test-browser")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def opened(browser):
    """Opens a file without network; at the end its console has not complained."""
    context, complaints = browser.new_context(offline=True, device_scale_factor=0.5), []
    page = context.new_page()
    page.set_default_timeout(300_000)  # ms: without a GPU, on a busy machine, a picture takes more than the usual 30 s
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def show(path, width=800):
        page.set_viewport_size({"width": width, "height": 1200})
        page.goto(path.as_uri())
        for frame in page.frames:
            frame.add_style_tag(content=STYLE)
        return page, page.frame_locator("iframe").locator("canvas[data-engine]")

    yield show
    context.close()
    assert not complaints


def grey(place):
    return Image.open(io.BytesIO(place.screenshot())).convert("L")


def assert_looks(page, name, *parts):
    """As before, as soon as all of it is drawn, and otherwise without any of its parts."""

    def differs():
        coarse = grey(page).resize(COARSE, Image.Resampling.BOX)
        return np.abs(np.asarray(coarse, dtype=float) - np.asarray(golden, dtype=float)).mean()

    if os.environ.get("FORCEGP_NEW_GOLDENS"):
        page.wait_for_timeout(20_000)
        grey(page).resize(COARSE, Image.Resampling.BOX).save(GOLDENS / f"{name}.png")
    golden, tries = Image.open(GOLDENS / f"{name}.png"), 0
    while (found := differs()) > ALIKE and (tries := tries + 1) < 20:
        page.wait_for_timeout(500)
    assert found < ALIKE
    for part in parts:
        part.evaluate("part => { part.style.opacity = 0 }")
        assert differs() > ALIKE
        part.evaluate("part => { part.style.opacity = 1 }")


def test_the_robot_moves_and_its_page_looks_as_before(opened, page, tmp_path):
    write_page(tmp_path / "report.html", page)
    shown, canvas = opened(tmp_path / "report.html")
    seen = []
    for _ in range(3):
        seen.append(np.asarray(grey(canvas), dtype=float))
        shown.wait_for_timeout(1_200)
    assert max(np.abs(seen[0] - seen[1]).max(), np.abs(seen[1] - seen[2]).max()) > 50.0
    shown.locator("iframe").evaluate("frame => { frame.style.opacity = 0 }")  # it is never twice the same
    assert_looks(shown, "report", *shown.locator("figure").all())


@pytest.mark.parametrize("name", LOGS)
def test_reports_look_as_before(opened, name, tmp_path):
    log, file = LOGS[name](), Path(simulation.__file__).parent / f"{name}.urdf"
    model = log.model.with_forces(AerodynamicForce() if name == "quadrotor" else JointFriction(), noise=0.1)
    posterior = fit(model, log, points=20, restarts=1, options=QUICK)
    still = replace(log.rows([40, 41]), time=np.array([0.0, 9.0]))
    page = model_page(posterior, still, title=name, best="It stands.", shapes=file if file.exists() else None)
    write_page(tmp_path / "report.html", page)
    shown, canvas = opened(tmp_path / "report.html")
    canvas.wait_for()
    assert_looks(shown, name, canvas, *shown.locator("figure").all()[:1])


@pytest.mark.parametrize("name", ["index", "tutorials/mathematics"])
def test_the_site_looks_as_before(opened, name):
    if not (path := SITE / f"{name}.html").exists():  # it takes two minutes, and `.ci/run` builds it before
        pytest.skip(f"{path} is not built: make docs")
    page, _ = opened(path, 1200)
    image = page.locator("article img").first
    image.scroll_into_view_if_needed()
    assert_looks(page, path.stem, image, page.locator(".sidebar-drawer"))
