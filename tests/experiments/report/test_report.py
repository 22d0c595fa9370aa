"""The pages of runs and of comparisons: whole, self-contained, and with every picture."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch
from report_page import PICTURES, check
from tiny_runs import run_by_options

from coim import HopperMorph, run_episode
from coim.experiments.commands.report import main
from coim.experiments.frames import designs_of, spearman_given
from coim.experiments.report.designs import describe_correlation
from coim.experiments.report.run_report import write_report
from coim.experiments.run.records import number, read_record, read_records
from tests.experiments.report.made_up_run import write_run


def test_the_page_says_what_share_of_the_imagined_pairs_cannot_be(reported: Path, tmp_path: Path) -> None:
    words = check(reported / "one" / "report.html").words
    assert "Share of imagined pairs with over 5 cm of the body in the floor" in words
    assert "share of a batch that is imagined" not in words
    run_by_options(tmp_path / "governed", "--quiet", "--num-designs", "2", "--governed")
    page = check(write_report([tmp_path / "governed"]))
    assert "Last: share of a batch that is imagined" in page.words


def test_the_end_of_a_run_writes_a_page_with_every_picture_beside_the_old_one(reported: Path) -> None:
    page = check(reported / "one" / "report.html")
    assert page.headings == ["Best bodies", *PICTURES, "Settings", "Versions and machine"]
    assert len(page.images) == len(PICTURES)
    assert (reported / "one" / "figures" / "designs.png").is_file()
    config = json.loads((reported / "one" / "config.json").read_text())
    assert all(name in page.words for name in config["settings"])
    assert config["versions"]["torch"] in page.words
    assert config["revision"] is None or config["revision"] in page.words
    assert "all 7 designs are done" in page.words
    assert "not defined (n = 2 designs after the first ones, four are needed)" in page.words
    (curves,) = [image["alt"] for image in page.images if image["alt"].startswith("Return over training steps")]
    bodies = HopperMorph(num_runs=4, episode_steps=config["settings"]["episode_steps"], seed=0)
    design = torch.tensor(HopperMorph.FIRST_DESIGNS[0]).expand(4, -1)
    by_chance = run_episode(bodies, None, design=design, rng=torch.Generator().manual_seed(0))["next", "reward"].sum(0)
    assert curves.endswith(f"Random actions on the first body: {number(float(by_chance.mean()))}.")


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_is_a_page_of_its_own(
    reported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    both, own = [str(reported / "one"), str(reported / "fleet")], reported / "one" / "report.html"
    before = own.read_bytes()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20260101-120000")  # two comparisons in one second
    for _ in range(2):
        main(both)
    said = [f"runs/comparison-20260101-120000{more}.html" for more in ("", "-2")]
    assert capsys.readouterr().out.split() == said
    main([*both, "--out", str(reported / "one")])
    assert capsys.readouterr().out.split() == [str(reported / "one" / "comparison.html")]
    for path in (*said, reported / "one" / "comparison.html"):
        assert check(Path(path)).headings[0] == "Best returns"
    assert own.read_bytes() == before


@pytest.mark.usefixtures("undrawn")
def test_a_folder_in_which_only_others_may_write_is_answered_by_out(
    reported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, contents: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("coim.experiments.report.run_report.write_whole", refuse)
    with pytest.raises(SystemExit, match=r"report.html cannot be written to \(Permission denied\).* with --out"):
        main([str(reported / "one")])


@pytest.mark.usefixtures("undrawn")
def test_a_body_that_is_not_ours_is_drawn_if_its_class_is_named(reported: Path, tmp_path: Path) -> None:
    theirs = shutil.copytree(reported / "one", tmp_path / "theirs")
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
def test_what_is_no_body_is_refused(reported: Path, body: str, sentence: str) -> None:
    with pytest.raises(SystemExit, match=f"^--body .*{sentence}"):
        main([str(reported / "one"), "--body", body])


def test_a_fleet_shows_the_mean_and_each_run(reported: Path) -> None:
    page = check(reported / "fleet" / "report.html")
    assert all(f"run {run}" in page.words for run in range(3))
    assert "mean of 3 runs" in page.words
    assert "not defined (n = 6 designs after the first ones, four are needed)" in page.words


def test_a_run_without_imagination_says_so_where_the_model_error_would_be(reported: Path) -> None:
    page = check(reported / "free" / "report.html")
    assert len(page.images) == len(PICTURES) - 2
    assert "What was imagined" not in page.headings
    assert "No model was learnt." in page.words


def test_folders_become_a_comparison(reported: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "new" / "comparison.html"
    main([str(reported / "fleet"), str(reported / "free"), "--out", str(out)])
    assert capsys.readouterr().out == f"{out}\n"
    page = check(out)
    assert page.headings[0] == "Best returns"
    assert len(page.images) == len(PICTURES)
    best = read_record(reported / "fleet", "").designs.groupby("run")["best_return"].max().tolist()
    assert f"{sum(best) / 3:.4g}" in page.words
    assert f"{max(best):.4g}" in page.words
    assert "imagine (differs)" not in page.words  # the mark is the style's, for eyes
    assert '<tr class="differs"><th scope="row">imagine</th>' in out.read_text()
    assert '<tr><th scope="row">task</th>' in out.read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_of_many_folders_has_several_tables_and_marks_differences_between_all(
    reported: Path, tmp_path: Path
) -> None:
    folders = [shutil.copytree(reported / "one", tmp_path / f"copy{i}") for i in range(11)]
    config = json.loads((folders[-1] / "config.json").read_text())
    config["settings"]["gamma"] = 0.5  # the only one, and in the second table
    (folders[-1] / "config.json").write_text(json.dumps(config))
    out = write_report(folders, out=tmp_path / "all.html")
    page = check(out)
    assert page.words.count("Versions and machine") == 1
    assert out.read_text().count('<tr class="differs"><th scope="row">gamma</th>') == 2
    assert all(f"copy{i}" in page.words for i in range(11))


def test_folders_of_one_name_are_told_apart_by_their_paths(reported: Path, tmp_path: Path) -> None:
    shutil.copytree(reported / "one", tmp_path / "one")
    assert [record.name for record in read_records([reported / "one", tmp_path / "one"])] == [
        str(reported / "one"), str(tmp_path / "one"),
    ]  # fmt: skip


@pytest.mark.usefixtures("undrawn")
def test_bodies_that_are_not_ours_are_not_drawn(reported: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(reported / "one", tmp_path / "run")
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
    reported: Path, tmp_path: Path, columns: tuple[str, ...], environment: str, names: tuple[str, ...]
) -> None:
    folder = shutil.copytree(reported / "one", tmp_path / "run")
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


def test_names_are_words_and_neither_tags_nor_formulas(reported: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(reported / "one", tmp_path / "a <b> & 'c\"")
    formula = shutil.copytree(reported / "one", tmp_path / "_$x_{1$")
    page = check(write_report([folder, formula]))
    assert "a <b> & 'c\"" in page.words
    assert "_$x_{1$" in page.words


def test_the_rank_correlation_is_told_of_each_run_after_the_first_bodies_and_with_the_order_held_fixed() -> None:
    def rows(*best: float, run: int = 0) -> pd.DataFrame:
        columns = {"design": range(1, 7), "kind": ["first"] * 2 + ["optimised", "random"] * 2, "run": run}
        return pd.DataFrame(columns | {"predicted": [90, 80, 2, 1, 4, 3], "best_return": best})

    # The order explains the rise of both; what it leaves agrees in one run and disagrees in the other.
    agreeing, other = rows(0, 9, 2, 1, 4, 3), rows(9, 0, 1, 2, 3, 4, run=1)
    assert describe_correlation(agreeing) == (
        "Spearman's rank correlation with the order of building held fixed 1.00 (n = 4 designs)"
    )
    by_hand = spearman_given([2, 1, 4, 3], [1, 3, 2, 4], given=[3, 4, 5, 6])
    mixed = pd.concat([agreeing, other.assign(best_return=[9, 0, 1, 3, 2, 4])])
    words = f"{(1 + by_hand) / 2:.2f}, mean of 2 runs, from {by_hand:.2f} to 1.00 (n = 4 each)"
    assert words in describe_correlation(mixed)
    assert describe_correlation(agreeing[:5]) == (
        "rank correlation not defined (n = 3 designs after the first ones, four are needed)"
    )


@pytest.mark.usefixtures("undrawn")
def test_long_runs_are_drawn_as_means_of_neighbouring_episodes(reported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coim.experiments.report.axes.MOST_EPISODES", 3)
    assert (
        "A point is the mean of 3 episodes."
        in check(write_report([reported / "one"], out=reported / "long.html")).words
    )


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
