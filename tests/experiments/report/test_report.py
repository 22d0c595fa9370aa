"""The report page: whole, self-contained, readable from any state of a run, and drawn by a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest
import torch
from matplotlib.image import imread
from tiny_runs import run_by_options

from coim import HalfCheetahMorph, HopperMorph, run_episode
from coim.experiments.commands.report import main
from coim.experiments.frames import designs_of
from coim.experiments.report.designs import describe_correlation
from coim.experiments.report.run_report import write_report
from coim.experiments.run.records import number, read_record, read_records
from tests.experiments.report.made_up_run import write_run

VOID = {"meta", "img", "br"}
PICTURES = ["Best return of each design", "Learning curves", "Designs over time", "Bodies", "Predicted and achieved"]
PICTURES += ["What the search was worth", "Model error over time", "What was imagined"]
PICTURES += ["Losses and entropy", "Time spent"]
CHROMIUM = shutil.which("chromium")


class Page(HTMLParser):
    """What is on a page; tags that do not close each other fail."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str]] = []
        self.links: list[str] = []
        self.headings: list[str] = []
        self.captions: list[str] = []
        self.cells: list[int] = []  # of each row of a table
        self.words = ""
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.links += [found[name] for name in ("src", "href") if name in found]
        if tag == "img":
            self.images.append(found)
        if tag == "tr":
            self.cells.append(0)
        if tag in ("th", "td"):
            self.cells[-1] += 1
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words += data
            if "h2" in self.open:
                self.headings.append(data)
            if "figcaption" in self.open:
                self.captions.append(data)


def check(path: Path) -> Page:
    """A page is well formed, fetches nothing, shows no NaN, and has short captions and narrow tables."""
    page = Page(path)
    assert page.images
    assert len(page.captions) == len(page.images)
    assert all(0 < len(caption.split()) <= 60 for caption in page.captions)
    assert max(page.cells) <= 10
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert not re.search(r"\bnan\b", page.words, re.IGNORECASE)
    for image in page.images:
        assert int(image["width"]) > 300
        assert int(image["height"]) > 100
        assert len(image["alt"]) > 20
        assert not re.search(r"\bnan\b", image["alt"], re.IGNORECASE)
        svg = base64.b64decode(image["src"].partition(",")[2]).decode()
        assert not re.search(r"\bnan\b", svg, re.IGNORECASE)  # words are outlines, with their text in comments
        root = ET.fromstring(svg)
        assert all(float(root.attrib[side].removesuffix("pt")) > 0 for side in ("width", "height"))
        hrefs = [value for node in root.iter() for key, value in node.attrib.items() if key.endswith("href")]
        assert all(href.startswith(("#", "data:")) for href in hrefs)
    return page


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished tiny runs: "one", "fleet" of three and "free", a fleet of two without imagination."""
    folder = tmp_path_factory.mktemp("runs")
    options = {"one": [], "fleet": ["--num-runs", "3"], "free": ["--num-runs", "2", "--imagine", "none"]}
    for name, more in options.items():
        run_by_options(folder / name, "--quiet", *more, page=name == "one")
        write_report([folder / name])
    return folder


def test_the_page_says_what_share_of_the_imagined_pairs_cannot_be(runs: Path, tmp_path: Path) -> None:
    words = check(runs / "one" / "report.html").words
    assert "Share of imagined pairs with over 5 cm of the body in the floor" in words
    assert "share of a batch that is imagined" not in words
    run_by_options(tmp_path / "governed", "--quiet", "--num-designs", "2", "--governed")
    page = check(write_report([tmp_path / "governed"]))
    assert "Last: share of a batch that is imagined" in page.words


def under_way(folder: Path, copy: Path, *, rows: int, torn: str = "") -> Path:
    """A copy as it was after that many rows of each table, and a piece of the next."""
    shutil.copytree(folder, copy)
    for name in ("evaluations.csv", "metrics.csv", "designs.csv"):
        lines = (copy / name).read_text().splitlines(keepends=True)
        kept = lines[: 1 + (0 if name == "designs.csv" else rows)]
        (copy / name).write_text("".join(kept) + torn)
    return copy


def test_the_end_of_a_run_writes_a_page_with_every_picture_beside_the_old_one(runs: Path) -> None:
    page = check(runs / "one" / "report.html")
    assert page.headings == ["Best bodies", *PICTURES, "Settings", "Versions and machine"]
    assert len(page.images) == len(PICTURES)
    assert (runs / "one" / "figures" / "designs.png").is_file()
    config = json.loads((runs / "one" / "config.json").read_text())
    assert all(name in page.words for name in config["settings"])
    assert config["versions"]["torch"] in page.words
    assert config["revision"] is None or config["revision"] in page.words
    assert "all 7 designs are done" in page.words
    assert "(n = 6 designs)" in page.words  # the first is built without a prediction
    (curves,) = [image["alt"] for image in page.images if image["alt"].startswith("Return over training steps")]
    bodies = HopperMorph(num_runs=4, episode_steps=config["settings"]["episode_steps"], seed=0)
    design = torch.tensor(HopperMorph.FIRST_DESIGNS[0]).expand(4, -1)
    by_chance = run_episode(bodies, None, design=design, rng=torch.Generator().manual_seed(0))["next", "reward"].sum(0)
    assert curves.endswith(f"Random actions on the first body: {number(float(by_chance.mean()))}.")


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_is_a_page_of_its_own(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    both, own = [str(runs / "one"), str(runs / "fleet")], runs / "one" / "report.html"
    before = own.read_bytes()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20260101-120000")  # two comparisons in one second
    for _ in range(2):
        main(both)
    said = [f"runs/comparison-20260101-120000{more}.html" for more in ("", "-2")]
    assert capsys.readouterr().out.split() == said
    main([*both, "--out", str(runs / "one")])
    assert capsys.readouterr().out.split() == [str(runs / "one" / "comparison.html")]
    for path in (*said, runs / "one" / "comparison.html"):
        assert check(Path(path)).headings[0] == "Best returns"
    assert own.read_bytes() == before


@pytest.mark.usefixtures("undrawn")
def test_a_folder_in_which_only_others_may_write_is_answered_by_out(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, contents: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("coim.experiments.report.run_report.write_whole", refuse)
    with pytest.raises(SystemExit, match=r"report.html cannot be written to \(Permission denied\).* with --out"):
        main([str(runs / "one")])


@pytest.mark.usefixtures("undrawn")
def test_a_body_that_is_not_ours_is_drawn_if_its_class_is_named(runs: Path, tmp_path: Path) -> None:
    theirs = shutil.copytree(runs / "one", tmp_path / "theirs")
    config = json.loads((theirs / "config.json").read_text())
    (theirs / "config.json").write_text(json.dumps(config | {"environment": "their_hopper"}))
    main([str(theirs)])
    without = len(check(theirs / "report.html").images)
    main([str(theirs), "--body", "coim.envs.hopper:HopperMorph"])
    assert len(check(theirs / "report.html").images) == without + 1


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("their_hopper", "it must be module:Class"),
        ("nowhere.hopper:Hopper", "cannot be found .*; start from the folder in which nowhere.hopper lies"),
        ("coim.envs.hopper:Hopper", "cannot be found"),
        ("pathlib:Path", "name a class that is derived from coim.MorphEnv"),
    ],
)
def test_what_is_no_body_is_refused(runs: Path, body: str, sentence: str) -> None:
    with pytest.raises(SystemExit, match=f"^--body .*{sentence}"):
        main([str(runs / "one"), "--body", body])


def test_a_fleet_shows_the_mean_and_each_run(runs: Path) -> None:
    page = check(runs / "fleet" / "report.html")
    assert all(f"run {run}" in page.words for run in range(3))
    assert "mean of 3 runs" in page.words
    assert "(n = 6 each)" in page.words


def test_a_run_without_imagination_says_so_where_the_model_error_would_be(runs: Path) -> None:
    page = check(runs / "free" / "report.html")
    assert len(page.images) == len(PICTURES) - 2
    assert "What was imagined" not in page.headings
    assert "No model was learnt." in page.words


def test_folders_become_a_comparison(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "new" / "comparison.html"
    main([str(runs / "fleet"), str(runs / "free"), "--out", str(out)])
    assert capsys.readouterr().out == f"{out}\n"
    page = check(out)
    assert page.headings[0] == "Best returns"
    assert len(page.images) == len(PICTURES)
    best = read_record(runs / "fleet", "").designs.groupby("run")["best_return"].max().tolist()
    assert f"{sum(best) / 3:.4g}" in page.words
    assert f"{max(best):.4g}" in page.words
    assert "imagine (differs)" not in page.words  # the mark is the style's, for eyes
    assert '<tr class="differs"><th scope="row">imagine</th>' in out.read_text()
    assert '<tr><th scope="row">task</th>' in out.read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_of_many_folders_has_several_tables_and_marks_differences_between_all(
    runs: Path, tmp_path: Path
) -> None:
    folders = [shutil.copytree(runs / "one", tmp_path / f"copy{i}") for i in range(11)]
    config = json.loads((folders[-1] / "config.json").read_text())
    config["settings"]["gamma"] = 0.5  # the only one, and in the second table
    (folders[-1] / "config.json").write_text(json.dumps(config))
    out = write_report(folders, out=tmp_path / "all.html")
    page = check(out)
    assert page.words.count("Versions and machine") == 1
    assert out.read_text().count('<tr class="differs"><th scope="row">gamma</th>') == 2
    assert all(f"copy{i}" in page.words for i in range(11))


def test_folders_of_one_name_are_told_apart_by_their_paths(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "one", tmp_path / "one")
    assert [record.name for record in read_records([runs / "one", tmp_path / "one"])] == [
        str(runs / "one"), str(tmp_path / "one"),
    ]  # fmt: skip


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_run_that_is_going_on_has_a_page(runs: Path, tmp_path: Path, rows: int) -> None:
    folder = under_way(runs / "fleet", tmp_path / "run", rows=rows, torn="2,1,fir")
    page = check(write_report([folder]))
    assert f"at design {1 if rows < 4 else 2} of 7, episode 1" in page.words
    assert "No design has both a prediction and a return yet" in page.words


@pytest.mark.usefixtures("undrawn")
def test_a_run_from_before_there_were_metrics_has_a_page(runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs / "one", tmp_path / "run")
    (folder / "metrics.csv").unlink()
    page = check(write_report([folder]))
    assert len(page.images) == len(PICTURES) - 3
    assert page.words.count("The folder has no metrics.csv") == 2
    assert "impossible pairs were not counted" in page.words


def test_numbers_that_are_none_are_gaps(runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs / "fleet", tmp_path / "run")
    kept = ("run", "design", "kind", "episode", "env_steps", "diverged")
    for name in ("evaluations.csv", "metrics.csv", "designs.csv"):
        head, *rows = (folder / name).read_text().splitlines()
        columns = head.split(",")
        broken = [
            row if row[0] != "1" else ",".join(
                cell if column in kept or column.startswith(("xi", "sec"))
                else "nan" for column, cell in zip(columns, row.split(","))
            ) for row in rows
        ]  # fmt: skip
        (folder / name).write_text("\n".join([head, *broken]) + "\n")
    page = check(write_report([folder]))
    assert "mean of 2 runs" in page.words
    best = read_record(folder, "").best
    assert best.index.tolist() == [0, 2]


@pytest.mark.usefixtures("undrawn")
def test_bodies_that_are_not_ours_are_not_drawn(runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs / "one", tmp_path / "run")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"environment": "giraffe"}))
    page = check(write_report([folder]))
    assert "giraffe is no environment of coim" in page.words
    assert not any("Random actions" in image["alt"] for image in page.images)
    assert len(check(write_report([folder], body=HopperMorph)).images) == len(PICTURES)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("columns", "environment", "names"),
    [
        (("xi_torso", "xi_thigh", "xi_shank", "xi_foot"), "giraffe", ("torso", "thigh", "shank", "foot")),
        (("xi_1", "xi_2", "xi_3", "xi_4"), "hopper", ("torso", "thigh", "shank", "foot")),
        (("xi_1", "xi_2", "xi_3", "xi_4"), "giraffe", ("design 0", "design 1", "design 2", "design 3")),
    ],
)
def test_entries_of_a_design_have_the_names_of_the_columns_or_of_the_body(
    runs: Path, tmp_path: Path, columns: tuple[str, ...], environment: str, names: tuple[str, ...]
) -> None:
    folder = shutil.copytree(runs / "one", tmp_path / "run")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"environment": environment}))
    for name in ("evaluations.csv", "designs.csv"):
        head, *rows = (folder / name).read_text().splitlines()
        head = head.replace("xi_torso,xi_thigh,xi_shank,xi_foot", ",".join(columns))
        (folder / name).write_text("\n".join([head, *rows]) + "\n")
    record = read_record(folder, "")
    assert record.design_names == names
    assert designs_of(record.designs)[0].tolist() == [1, 1, 1, 1]
    page = check(write_report([folder]))
    assert all(name in page.words for name in names)
    assert any(f"Scale factors over designs: {', '.join(names)}." in image["alt"] for image in page.images)


def test_the_tables_in_docs_that_count_the_entries_are_read_with_the_names_of_the_body() -> None:
    kept = Path(__file__).parents[3] / "docs" / "results" / "preview" / "cells" / "half_cheetah-forward-none-0"
    record = read_record(kept, kept.name)
    assert record.design_names == HalfCheetahMorph.design_names()
    assert designs_of(record.designs).shape[1] == 6


def test_names_are_words_and_neither_tags_nor_formulas(runs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs / "one", tmp_path / "a <b> & 'c\"")
    formula = shutil.copytree(runs / "one", tmp_path / "_$x_{1$")
    page = check(write_report([folder, formula]))
    assert "a <b> & 'c\"" in page.words
    assert "_$x_{1$" in page.words


def test_what_is_no_run_gets_a_sentence(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    other = shutil.copytree(runs / "one", tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"environment": "walker"}))
    empty = under_way(runs / "one", tmp_path / "empty", rows=0)
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    torn = shutil.copytree(runs / "one", tmp_path / "torn")
    (torn / "config.json").write_text('{"environment": ')
    cases = {
        "nothing holds no run: ": [nothing],
        "missing holds no run": [tmp_path / "missing"],
        "evaluations.csv has no rows": [empty],
        "hold runs of hopper and walker; compare runs of one environment": [runs / "one", other],
        "config.json is damaged": [torn],
        "no folder is named": [],
    }
    for sentence, folders in cases.items():
        with pytest.raises(SystemExit) as stop:
            main([str(folder) for folder in folders])
        said = f"{stop.value.code}"
        assert sentence in said
        assert "\n" not in said
    assert not (nothing / "report.html").exists()


def test_the_rank_correlation_is_told_of_each_run() -> None:
    def rows(*pairs: tuple[float, float], run: int = 0) -> pd.DataFrame:
        return pd.DataFrame(pairs, columns=["predicted", "best_return"]).assign(run=run)

    rising, falling = rows((1, 1), (2, 10), (3, 11)), rows((1, 9), (2, 3), (3, 2), run=1)
    assert describe_correlation(rising) == "Spearman's rank correlation 1.00 (n = 3 designs)"
    both = pd.concat([rising, falling])
    assert "0.00, mean of 2 runs, from -1.00 to 1.00 (n = 3 each)" in describe_correlation(both)
    assert describe_correlation(rising[:0]) == "rank correlation not defined (n = 0 designs)"


@pytest.mark.usefixtures("undrawn")
def test_long_runs_are_drawn_as_means_of_neighbouring_episodes(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coim.experiments.report.axes.MOST_EPISODES", 3)
    assert "A point is the mean of 3 episodes." in check(write_report([runs / "one"], out=runs / "long.html")).words


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["evaluations.csv", "designs.csv", "metrics.csv"])
def test_a_page_is_not_made_of_half_a_table(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, name: str
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(runs / "fleet", folder, ignore=shutil.ignore_patterns("report.html", "checkpoint"))
    text = (folder / name).read_text()
    (folder / name).write_text("\ufeff" + text)
    main([str(folder)])
    page = (folder / "report.html").read_text()
    head, first, second, *others = text.splitlines(keepends=True)
    torn = {2: [head, first[:9] + "\n", second, *others], 3: [head, first, second.replace(",", ",x,", 1), *others]}
    for line, lines in torn.items():
        (folder / name).write_text("".join(lines))
        with pytest.raises(SystemExit, match=rf"{name}, line {line}: found .*, expected") as stop:
            main([str(folder)])
        assert "\n" not in str(stop.value)
    assert (folder / "report.html").read_text() == page


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_browser_draws_the_page(runs: Path, tmp_path: Path) -> None:
    page = runs / "fleet" / "report.html"
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


@pytest.mark.usefixtures("undrawn")
def test_the_page_has_the_film_of_the_best_body_or_says_how_to_make_it_and_settings_are_folded(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", [1.0, 3.0, 2.0])
    text = write_report([folder]).read_text()
    assert "<video" not in text
    assert "coim watch" not in text  # which needs the policy
    (folder / "policies").mkdir()
    (folder / "policies/design-2.pt").touch()
    told = f"no film of the best body yet. coim watch {folder} makes it, then coim report {folder} puts it here"
    assert told in write_report([folder]).read_text()
    (folder / "videos").mkdir()
    (folder / "videos/design-1.mp4").write_bytes(b"another")
    (folder / "videos/design-2.mp4").write_bytes(b"best")
    text = write_report([folder]).read_text()
    assert "coim watch" not in text
    assert re.findall(r'src="data:video/mp4;base64,([^"]*)"', text) == [base64.b64encode(b"best").decode()]
    assert re.findall(r"<summary><h2>(.*?)</h2></summary>", text) == ["Settings", "Versions and machine"]


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
