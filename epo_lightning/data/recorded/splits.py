"""Splits of recordings into training, validation and test, and advice where a split would be empty."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from epo_lightning.data.cache import SPLITS
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.registry import ConfigError, nearest

UNITS = ("recording", "group")
ALL = "all"
"""Name of the split that has all recordings, for tests of forecasters that learned on other data."""
SEEDS, SUGGESTED = 100, 3
"""Number of seeds that are tried where a split is empty, and largest number of those that an error suggests."""
NAMED, LONGEST = 12, 1500
"""Largest number of recordings that an error lists, and of characters of a sentence in it."""


@dataclass(frozen=True)
class SplitRule:
    """Rule by which the recordings of a folder are divided into splits; the keys are those of ``data``.

    Attributes:
        test: groups of the test split; None to draw a share ``test_share`` of them.
        test_share: share of the groups that is drawn for the test split.
        val_share: share of the remaining recordings or groups that is drawn for the validation split.
        val_by: ``recording`` or ``group``.
        seed: seed of the draws.
    """

    test: tuple[str, ...] | None
    test_share: float
    val_share: float
    val_by: str
    seed: int

    def of(self, sources: Sequence[RecordingSource]) -> dict[str, list[RecordingSource]]:
        """The recordings of each split; a split may be empty.

        Raises:
            ConfigError: ``test`` is empty or names a group that does not exist.
        """
        draw = np.random.default_rng([self.seed, 4])
        groups = sorted({source.group for source in sources})
        if self.test is None:
            chosen = set(draw.permutation(groups)[: max(1, round(self.test_share * len(groups)))].tolist())
        else:
            chosen = set(self.test)
            if not chosen:
                raise ConfigError(
                    f"data.test is empty: name one or more of the groups {', '.join(groups)}, or set it to null, which "
                    "draws data.test_share of them"
                )
            for group in sorted(chosen - set(groups)):
                raise ConfigError(
                    f"data.test names the group {group!r}, which no recording has: {nearest(group, groups)}; "
                    "data.test=null draws the test split"
                )
        rest = [source for source in sources if source.group not in chosen]
        unit = "name" if self.val_by == "recording" else "group"
        units = sorted({getattr(source, unit) for source in rest})
        held = set(draw.permutation(units)[: max(1, round(self.val_share * len(units)))].tolist())
        return {
            "train": [source for source in rest if getattr(source, unit) not in held],
            "val": [source for source in rest if getattr(source, unit) in held],
            "test": [source for source in sources if source.group in chosen],
        }

    def checked(self, sources: Sequence[RecordingSource]) -> dict[str, list[RecordingSource]]:
        """The recordings of each split.

        Raises:
            ConfigError: as :meth:`of`, or a split without recordings.
        """
        found = self.of(sources)
        empty = [split for split in SPLITS if not found[split]]
        if empty:
            groups = {source.group for source in sources}
            listed = "; ".join(
                f"group {group}: {_some([source.name for source in members])}"
                for group, members in groupby(sorted(sources, key=lambda source: source.group), lambda one: one.group)
            )
            raise ConfigError(
                f"{len(sources)} recording(s) in {len(groups)} group(s) are too few: no recording is left for "
                f"{', '.join(empty)}; each of the three splits needs recordings of its own. {_sentence(listed)}. "
                f"{self._advice(sources, {source.name for source in sources})}"
            )
        return found

    def refuse_empty(
        self,
        dataset: str,
        sources: Sequence[RecordingSource],
        splits: Mapping[str, Sequence[RecordingSource]],
        counts: Mapping[str, Mapping[str, int]],
        warned: Mapping[str, Sequence[str]],
    ) -> None:
        """Check that every split has scenes.

        Args:
            dataset: name of the data set, for the error.
            sources: the recordings.
            splits: the recordings of each split.
            counts: for each recording by name, windows, windows that were left out by reason, and scenes.
            warned: warnings of each recording by name.

        Raises:
            ConfigError: a split has no scene; names its recordings, the reasons, and what to change.
        """
        for split, held in splits.items():
            names = [source.name for source in held]
            if any(counts[name].get("scenes") for name in names):
                continue
            total: dict[str, int] = {}
            for name in names:
                for reason, count in counts[name].items():
                    total[reason] = total.get(reason, 0) + count
            gone = ", ".join(f"{reason}: {count}" for reason, count in total.items() if count) or "no window at all"
            full = {source.name for source in sources if counts[source.name].get("scenes")}
            advice = (
                f"{self._advice(sources, full)} Or relax data.windows."
                if full and split != ALL
                else "Relax data.windows."
            )
            said = list(dict.fromkeys(f"Warning of {name}: {text}" for name in names for text in warned[name]))[:2]
            raise ConfigError(
                f"the split {split!r} of {dataset} has no scene ({gone}). Its recordings are {_some(names)}. "
                f"{' '.join([*said, advice])}"
            )

    def _advice(self, sources: Sequence[RecordingSource], full: Collection[str]) -> str:
        """Advice on the change by which every split gets one of the recordings in ``full``, which have scenes."""
        holding = sorted({source.group for source in sources if source.name in full})
        if self.test is not None:
            now = f"data.test={list(self.test)}, data.seed={self.seed}"
            drawn = f"data.test=null draws the test split; groups with scenes are {_some(holding)}"
        else:
            now = f"data.seed={self.seed}, data.test=null"
            named = "data.test can name test groups; " if len(holding) > 1 else ""
            drawn = f"{named}groups with scenes are {_some(holding)}"
        helps = [f"{key}={value}" for key, value in self._alternatives(sources, full)]
        of_another_group = " of another group" if len(holding) == 1 else ""
        by_recording = "" if self.val_by == "recording" else ", or set data.val_by=recording"
        change = (
            f"Set {' or '.join(helps)}, which gives every split recordings with scenes"
            if helps
            else f"None of data.seed=0..{SEEDS - 1} and of the groups for data.test gives every split a recording with "
            f"scenes: add recordings{of_another_group}{by_recording}"
        )
        shares = f"data.test_share={self.test_share}, data.val_share={self.val_share}"
        return f"The splits follow from {now}, {shares}. {change}; {drawn}."

    def _alternatives(self, sources: Sequence[RecordingSource], full: Collection[str]) -> Iterator[tuple[str, str]]:
        """Keys and values (some seeds, one test group) that give every split one of the recordings in ``full``."""

        def works(rule: SplitRule) -> bool:
            return all(any(source.name in full for source in held) for held in rule.of(sources).values())

        seeds = (seed for seed in range(SEEDS) if works(replace(self, seed=seed)))
        for _, seed in zip(range(SUGGESTED), seeds, strict=False):
            yield "data.seed", str(seed)
        for group in sorted({source.group for source in sources if source.name in full}):
            if works(replace(self, test=(group,))):
                yield "data.test", f"[{group}]"
                return


def _some(names: Sequence[str]) -> str:
    """Names for a message; of many, the first ones and the number of the others."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "") or "none"


def _sentence(text: str) -> str:
    """A text of at most ``LONGEST`` characters that begins with a capital letter."""
    text = text if len(text) <= LONGEST else text[:LONGEST] + " ..."
    return text[:1].upper() + text[1:]
