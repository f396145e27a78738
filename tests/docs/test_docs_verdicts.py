"""The page of verdicts: every claim has all its parts and one verdict, and differences are those of the results files."""

from __future__ import annotations

import re
from math import sqrt
from statistics import fmean, stdev

import pytest
from docs.pages import ROOT
from scipy.stats import t as student

from epo_lightning.report.results import read_results

PAGE = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^### (\d+)\. (.*?)\n(.*?)(?=^##|\Z)", PAGE, re.DOTALL | re.MULTILINE)
VERDICTS = ("holds", "holds weakly", "holds in part", "does not hold", "undecided", "not tested")


@pytest.mark.parametrize(("number", "title", "text"), SECTIONS, ids=[number for number, _, _ in SECTIONS])
def test_a_claim_has_all_its_parts_and_one_verdict(number: str, title: str, text: str) -> None:
    parts = re.findall(r"^- \*\*(\w+)\*\*", text, re.MULTILINE)
    assert parts[:-1] == ["Claim", "Paper", "Ours", "Difference", "Verdict", "Cause"], title
    assert parts[-1] in ("Table", "Tables"), title
    verdict = re.findall(r"^- \*\*Verdict\*\*: (.*)\.$", text, re.MULTILINE)
    assert len(verdict) == 1
    assert verdict[0] in VERDICTS
    assert re.search(rf"^\| \[{number} .*\]\(#{number}-.*\) \| {verdict[0]} \|$", PAGE, re.MULTILINE), title


def test_the_summary_has_every_claim_once() -> None:
    assert [int(number) for number in re.findall(r"^\| \[(\d+) ", PAGE, re.MULTILINE)] == list(
        range(1, len(SECTIONS) + 1)
    )


def scores(file: str, experiment: str, metric: str) -> dict[int, float]:
    """The score of every seed of a row."""
    report = read_results(ROOT / "results" / f"{file}.json")
    return {run.seed: run.metrics[metric] for run in report.evaluated if run.experiment == experiment}


@pytest.mark.parametrize(
    ("first", "second", "metric"),
    [
        (("rpi_hard_settled", "rpi/v_lstm_epo_relaxed"), ("rpi_hard_settled", "rpi/v_lstm_sc_relaxed"), "minSADE"),
        (("rpi_hard_settled", "rpi/v_lstm_epo_relaxed"), ("rpi_hard_settled", "rpi/v_lstm_sc_relaxed"), "minSFDE"),
        (("rpi_hard_settled", "rpi/v_lstm_sc_relaxed"), ("rpi_hard_settled", "rpi/v_lstm_relaxed"), "minSFDE"),
        (("rpi_paper_split", "rpi/v_lstm_epo_relaxed"), ("rpi_paper_split", "rpi/v_lstm_sc_relaxed"), "minSADE"),
        (("rpi_hard", "rpi/v_lstm_epo"), ("rpi_hard", "rpi/v_lstm_sc"), "minSADE"),
        (("rpi_hard", "rpi/v_lstm_epo_relaxed"), ("rpi_hard", "rpi/v_lstm_epo_relaxed_no_pair"), "minSADE"),
    ],
)
def test_the_page_has_the_paired_differences(first: tuple[str, str], second: tuple[str, str], metric: str) -> None:
    one, other = scores(*first, metric), scores(*second, metric)
    found = [one[seed] - other[seed] for seed in sorted(one.keys() & other.keys())]
    half = student.ppf(0.975, len(found) - 1) * stdev(found) / sqrt(len(found))
    mean = fmean(found)
    shown = [f"{value:+.4f}".replace("0.", ".", 1) for value in (mean, mean - half, mean + half)]
    assert f"{shown[0]} ({shown[1]} to {shown[2]})" in PAGE
