"""How large the viewer's pages are and how fast they answer: a folder of `augkitti view` in, a table out.

`python benchmarks/viewer.py augkitti-view` opens up to eight of its pairs, each in a headless Chromium of its own,
drawn by the processor alone. Ready: from the start of loading until the first picture is drawn and keys are answered.
"""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, sync_playwright

FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
MOST = 8
TIMED = "(() => {{ const t = performance.now(); {0} scene.wait(); return performance.now() - t; }})()"


def main() -> None:
    folder = Path(sys.argv[1])
    pages = sorted((folder / "pairs").glob("*.html"))
    shown = [pages[i] for i in np.unique(np.linspace(0, len(pages) - 1, MOST).round().astype(int))]
    alone = ["--no-sandbox"] if os.geteuid() == 0 else []
    ready, frames, picks = [], [], []
    with sync_playwright() as play:
        for page in shown:
            browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=[*FLAGS, *alone])
            numbers = measure(browser, page)
            browser.close()
            for column, number in zip((ready, frames, picks), numbers, strict=True):
                column.append(number)
    sizes = [page.stat().st_size / 1e6 for page in pages]
    shared = sum(path.stat().st_size for path in (folder / "static").iterdir()) / 1e6
    load = os.getloadavg()[0]
    print(f"{len(pages)} pages of {min(sizes):.2f} to {max(sizes):.2f} MB, {shared:.2f} MB shared; load {load:.1f}")
    for name, column in (("ready, ms", ready), ("a frame, ms", frames), ("a pick, ms", picks)):
        print(f"{name}: median {np.median(column):.0f}, most {max(column):.0f} of {len(column)} pages")


def measure(browser: Browser, path: Path) -> tuple[float, float, float]:
    """Milliseconds until ready, of a frame while turning, and of finding the point under the cursor."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.resolve().as_uri())
    page.wait_for_function("document.body.dataset.readyMs", timeout=60_000)
    ready = float(page.evaluate("document.body.dataset.readyMs"))
    frame = np.median([page.evaluate(TIMED.format("scene.camera.bearing += 0.05; frame();")) for _ in range(7)])
    pick = np.median([page.evaluate(TIMED.format(f"pick({300 + i}, 300);")) for i in range(7)])
    return ready, float(frame), float(pick)


if __name__ == "__main__":
    main()
