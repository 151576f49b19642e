"""Records the robot of a report in motion, as the front page shows it: `python record.py demo/report.html demo.webp`.

Needs Chromium and `pip install 'forcegp[browser]'`.
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES, EVERY, WIDTH = 80, 125, 560  # milliseconds, pixels
AROUND = 0.33, 0.04, 0.87, 0.98  # what is kept of the scene: beside its notes, around the robot


def record(report: Path, out: Path) -> None:
    """The scene of a report, as an animation of ten seconds."""
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 900})
        page.set_default_timeout(300_000)
        page.goto(report.resolve().as_uri())
        canvas = page.frame_locator("iframe").locator("canvas").first
        canvas.wait_for()
        page.wait_for_timeout(6_000)
        frames = [Image.open(io.BytesIO(canvas.screenshot())).convert("RGB") for _ in range(FRAMES)]
        browser.close()
    box = tuple(round(part * size) for part, size in zip(AROUND, 2 * frames[0].size, strict=True))
    size = (WIDTH, round(WIDTH * (box[3] - box[1]) / (box[2] - box[0])))
    first, *others = (frame.crop(box).resize(size, Image.Resampling.LANCZOS) for frame in frames)
    first.save(out, save_all=True, append_images=others, duration=EVERY, loop=0, quality=55, method=4)


if __name__ == "__main__":
    record(Path(sys.argv[1]), Path(sys.argv[2]))
