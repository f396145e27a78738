"""Commands that only read configurations and records: they start in one or two seconds, because they import no PyTorch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMMANDS = (
    ["train", "--help"],
    ["config", "experiment=rpi/v_lstm_epo", "data=rpi_hard"],
    ["sweep"],
    ["sweep", "status"],
    ["report", f"results={ROOT / 'results' / 'game.json'}"],
)
SCRIPT = f"""
import sys
from epo_lightning.cli import main
for words in {COMMANDS!r}:
    main(words)
print("heavy:", sorted({{"torch", "lightning", "torchmetrics"}} & set(sys.modules)))
"""


def test_commands_that_only_read_import_no_pytorch(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "heavy: []"
    assert (tmp_path / "report" / "game" / "results.md").is_file()
