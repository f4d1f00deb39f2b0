"""The page in headless Chromium: no console errors, and the interactions do what they say."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.base.paths import RunFolder
from pipeline.data.kitti_object import read_labels, write_objects
from tests.pipeline.report.scored import score_and_report

# What a reader does, and what the page then says of itself, written into the end of the page.
ACTIONS = """
addEventListener("load", () => {
  const said = {};
  const cloud = document.querySelector(".cloud"), view = AugCloud.open(cloud), canvas = cloud.querySelector("canvas");
  const key = (target, name) => target.dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true }));
  view.draw();
  const inked = () => {
    const data = view.context.getImageData(0, 0, canvas.width, canvas.height).data;
    let count = 0;
    for (let i = 0; i < data.length; i += 4) count += data[i] !== 17 || data[i + 1] !== 21;
    return count;
  };
  said.live = cloud.classList.contains("live");
  said.ink = inked() > 100;
  const start = [view.yaw, view.pitch, view.distance];
  key(canvas, "ArrowLeft"); key(canvas, "ArrowUp"); key(canvas, "+");
  said.turned = view.yaw !== start[0] && view.pitch > start[1] && view.distance < start[2];
  key(canvas, "r");
  said.reset = [view.yaw, view.pitch, view.distance].join() === start.join();
  const pointer = (kind, x, y, id) => new PointerEvent(kind, { pointerId: id, clientX: x, clientY: y, bubbles: true });
  const at = (...event) => canvas.dispatchEvent(pointer(...event));
  canvas.setPointerCapture = () => {};
  at("pointerdown", 100, 100, 1); at("pointermove", 140, 110, 1);
  said.dragged = view.yaw !== start[0];
  const far = view.distance;
  at("pointerdown", 240, 110, 2); at("pointermove", 340, 110, 2);
  at("pointerup", 340, 110, 2); at("pointerup", 140, 110, 1);
  said.pinched = view.distance < far;
  const select = cloud.querySelector("select");
  said.colours = [...select.options].map((option) => option.value).join();
  select.value = "noise"; select.dispatchEvent(new Event("change"));
  said.legend = cloud.querySelector(".cloud-legend").textContent;
  cloud.querySelector('[data-look="above"]').click();
  said.above = view.pitch === 1.5;
  key(document.body, "j");
  said.hash = location.hash;
  const low = () => document.querySelectorAll(".box.found.low").length;
  said.low = low();
  key(document.body, "0");
  said.all = low();
  key(document.body, "0");
  said.back = low();
  said.start = document.getElementById("score-text").textContent;
  key(document.body, "j");
  key(document.body, "1");
  said.hidden = getComputedStyle(document.querySelector(".box.truth")).display;
  const map = document.querySelectorAll(".pointed")[1], edge = map.getBoundingClientRect();
  map.dispatchEvent(pointer("pointermove", edge.left + edge.width / 2, edge.top + 0.6 * edge.height, 3));
  said.values = [...map.closest("article").querySelectorAll("output")].map((out) => out.textContent).join("|");
  const slider = document.getElementById("score");
  slider.value = 100; slider.dispatchEvent(new Event("input"));
  said.score = document.getElementById("score-text").textContent;
  said.wide = document.documentElement.scrollWidth <= innerWidth;
  for (const [name, value] of Object.entries(said)) document.body.setAttribute(`data-said-${name}`, value);
});
"""


def browse(page: Path, profile: Path, *options: str) -> tuple[str, str]:
    """(document, log) after the page has run for three virtual seconds; skips without a browser."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0"]
    command += [f"--user-data-dir={profile}", "--virtual-time-budget=3000", *options, "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    return done.stdout, done.stderr


@pytest.mark.slow
def test_interactions_work_without_console_errors(run: RunFolder, tmp_path: Path) -> None:
    sure = read_labels(run.detections("000000"), scored=True)
    write_objects(run.detections("000000"), [*sure, replace(sure[0], score=-5.0)])
    text = score_and_report(run)
    run.report.write_text(text.replace("</body>", f"<script>{ACTIONS}</script></body>"), encoding="utf-8")
    document, log = browse(run.report, tmp_path / "profile", "--window-size=1200,900")
    assert ":CONSOLE" not in log
    said = dict(re.findall(r'data-said-(\w+)="([^"]*)"', document))
    for name in ("live", "ink", "turned", "reset", "dragged", "pinched", "above", "wide"):
        assert said[name] == "true", name
    assert said["colours"] == "source,sigma,class,noise,distance,height"
    assert "noise-fg" in said["legend"]
    assert "noise-bg" not in said["legend"]  # this run has none, and the legend names only what is there
    assert said["hash"] == "#frame-1"
    assert said["hidden"] == "none"
    # The box of score -5 is below the threshold of the detector's card: in the image and from above.
    assert (said["low"], said["all"], said["back"]) == ("2", "0", "2")
    # Completed 9 m, foreground and true depth 8 m, background 10 m, sigma 128 / 255, error 1 m on the car.
    values = said["values"].split("|")
    assert values[1:] == ["9.00 m", "8.00 m", "10.00 m", "2.00 m", "0.50", "8.00 m", "1.00 m"]
    assert said["score"] == "Car 1.00"


@pytest.mark.slow
def test_without_a_canvas_the_picture_stays(run: RunFolder, tmp_path: Path) -> None:
    text = score_and_report(run)
    broken = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script>"
    opened = "<script>AugCloud.open(document.querySelector('.cloud'));</script></body>"
    run.report.write_text(text.replace("<body>", "<body>" + broken).replace("</body>", opened), encoding="utf-8")
    document, log = browse(run.report, tmp_path / "profile")
    assert ":CONSOLE" not in log
    assert "This browser cannot draw the cloud (no canvas)" in document
    assert 'class="cloud live"' not in document
