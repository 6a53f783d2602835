"""Makes docs/viewer.jpg: python test/viewer/viewer_picture.py MODEL.ply docs/viewer.jpg (needs viser, playwright, Chromium)."""

import shutil
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.standalone import Standalone, camera_at_origin

SIZE = 1100, 660
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
HOLD, TO = (390, 290), (390, 200)  # where the mouse takes hold, and where it lifts to


def main(model: Path, out: Path) -> None:
    beside = model.parent / "cameras.json"
    gaussians = load_ply(model)
    cameras = load_cameras(beside) if beside.is_file() else [camera_at_origin(gaussians)]
    page = Standalone(gaussians, cameras, PhysicsConfig(node_count=6000), ViewerConfig(port=8190, max_force=4.0))
    going = threading.Event()
    going.set()

    def drive() -> None:
        while going.is_set():
            page.turn()

    thread = threading.Thread(target=drive)
    thread.start()
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    try:
        with sync_playwright() as playwright:
            tab = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS).new_page(
                viewport=dict(zip(("width", "height"), SIZE))
            )
            tab.goto(page.viewer.url)
            tab.wait_for_timeout(12_000)
            tab.get_by_role("alert").get_by_role("button").click()  # that there is no GPU
            tab.locator('input[value="hidden"]').first.click()
            tab.get_by_role("option", name="stress").click()
            tab.keyboard.down("Control")
            tab.mouse.move(*HOLD)
            tab.mouse.down()
            tab.mouse.move(*TO, steps=4)
            tab.wait_for_timeout(10_000)
            image = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    finally:
        going.clear()
        thread.join()
        page.viewer.stop()
    cv2.imwrite(str(out), image, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
