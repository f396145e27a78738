"""Verdicts and evidence: every claim has all its parts and one verdict, which the page of verdicts repeats."""

from __future__ import annotations

import re

import pytest
from docs.pages import ROOT

PAGE = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
EVIDENCE = (ROOT / "docs" / "claims.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^### (\d+)\. (.*?)\n(.*?)(?=^##|\Z)", EVIDENCE, re.DOTALL | re.MULTILINE)
VERDICTS = ("holds", "holds weakly", "holds in part", "does not hold", "undecided", "not tested")


@pytest.mark.parametrize(("number", "title", "text"), SECTIONS, ids=[number for number, _, _ in SECTIONS])
def test_a_claim_has_all_its_parts_and_one_verdict(number: str, title: str, text: str) -> None:
    parts = re.findall(r"^\*\*(\w+)\*\*", text, re.MULTILINE)
    assert parts[0] in ("Claim", "Question"), title
    assert parts[1:] == ["Verdict", "Cause", "Tables"], title
    claim, _, rest = text.partition("**Verdict**")
    assert "\n|:--|" in claim, f"{title}: its numbers stand in a table"
    verdict = re.match(r": (.*)\.\n", rest)
    assert verdict is not None
    assert verdict[1] in VERDICTS
    assert re.search(rf"^\| \[{number} .*\]\(claims\.md#{number}-.*\) \| {verdict[1]} \| .*\|$", PAGE, re.MULTILINE), (
        title
    )


def test_the_summary_has_every_claim_once() -> None:
    assert [int(number) for number in re.findall(r"^\| \[(\d+) ", PAGE, re.MULTILINE)] == list(
        range(1, len(SECTIONS) + 1)
    )


def test_the_counts_of_verdicts_are_those_of_the_table() -> None:
    of_the_paper = PAGE.partition("| question of our own |")[0]
    verdicts = re.findall(r"^\| \[\d+ .*?\]\(claims\.md#.*?\) \| ([a-z ]+) \| ", of_the_paper, re.MULTILINE)
    said = "2 hold, 12 hold in part, 2 do not hold, 1 is undecided and 1 is not tested"
    counts = [int(number) for number in re.findall(r"\d+", said)]
    assert f"Of these {len(verdicts)} rows, {said}." in PAGE
    wanted = ("holds", "holds in part", "does not hold", "undecided", "not tested")
    assert counts == [verdicts.count(verdict) for verdict in wanted]


def test_every_verdict_has_a_rule() -> None:
    assert (
        tuple(
            re.findall(
                r"^\| ([a-z ]+) \| ", PAGE.partition("| verdict | rule |")[2].partition("**Words")[0], re.MULTILINE
            )
        )
        == VERDICTS
    )
