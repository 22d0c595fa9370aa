"""The page as a browser draws it."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from matplotlib.image import imread
from report_page import PICTURES

from coim.experiments.report.run_report import write_report
from tests.experiments.report.made_up_run import write_run

CHROMIUM = shutil.which("chromium")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_draws_the_page(reported: Path, tmp_path: Path) -> None:
    page = reported / "fleet" / "report.html"
    shot = tmp_path / "page.png"
    log = browse(tmp_path, f"--screenshot={shot}", "--window-size=1100,6000", page).stderr
    assert "CONSOLE" not in log
    pixels = imread(shot)[..., :3]
    assert pixels.shape[0] == 6000
    inked = (pixels.min(-1) < 0.9).mean(1) > 0
    assert inked[:1000].any()
    assert inked.mean() > 0.3  # of the lines of pixels: not a heading on an empty page
    # The page itself has no script; this one reports what the browser made of the pictures.
    asking = tmp_path / "asking.html"
    script = "<script>onload = () => document.querySelectorAll('img').forEach(i => i.title = "
    script += "[i.complete, i.naturalWidth, i.clientWidth, i.clientHeight].join())</script></body>"
    asking.write_text(page.read_text().replace("</body>", script))
    answers = re.findall(r'title="(true|false),(\d+),(\d+),(\d+)"', browse(tmp_path, "--dump-dom", asking).stdout)
    assert len(answers) == len(PICTURES)
    assert all(complete == "true" and min(map(int, sizes)) > 100 for complete, *sizes in answers)


def browse(folder: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Open a page in a browser without a screen, a network or a past."""
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--enable-logging=stderr",
    ]
    command = [str(CHROMIUM), *flags, f"--user-data-dir={folder / 'browser'}", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
@pytest.mark.usefixtures("undrawn")
def test_on_a_phone_a_table_scrolls_in_its_box_and_no_number_is_broken_over_lines(tmp_path: Path) -> None:
    told = {"expected": [None, 1234.5, 1234.5, 1234.5], "deviation": [None, 100.0, 100.0, 100.0]}
    page = write_report([write_run(tmp_path / "run", [1000.0, 3000.0, 2000.0, 1500.0], told=told, chosen_by="returns")])
    script = "<script>onload = () => { document.body.style.width = '340px'; document.body.title = "
    script += "[...document.querySelectorAll('section:not(:has(details)) td')].map(cell => cell.clientHeight).join() }"
    page.write_text(page.read_text().replace("</body>", f"{script}</script></body>"))
    (heights,) = re.findall(r'<body [^>]*title="([\d,]+)"', browse(tmp_path, "--dump-dom", page).stdout)
    assert max(map(int, heights.split(","))) < 40  # pixels: a line has 25
