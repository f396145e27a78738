"""Records of a run: permissions by the umask, no secrets, commands quoted for a shell."""

from __future__ import annotations

import os
import resource
import shlex
import subprocess
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from experiment import tiny
from experiment.conftest import TINY, Epo
from report.run_folders import make_run, scores

from epo_lightning.experiment import provenance
from epo_lightning.files import write_file
from epo_lightning.masking import is_masked, mask
from epo_lightning.run_folder import RunFolder

ROW = "experiment=rpi/v_lstm_sc"


@pytest.fixture
def umask() -> Iterator[int]:
    """A umask that both adds to and takes from the usual permissions: the group may write, others may not read."""
    value = 0o007
    before = os.umask(value)
    yield value
    os.umask(before)


def test_permissions_of_files_follow_the_umask(epo: Epo, umask: int, tmp_path: Path) -> None:
    words = ("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/v_lstm_epo", "score=test")
    assert epo(*words, "logger=[tensorboard]") == 0
    assert epo("predict", "run=runs/rpi/v_lstm_epo/" + next(Path("runs/rpi/v_lstm_epo").iterdir()).name) == 0
    assert epo("report", "rpi_main") == 0
    entries = list(tmp_path.rglob("*"))
    assert {"metrics.csv", "best.ckpt", "index.html", "run.json", "sweep.json"} <= {path.name for path in entries}
    for path in entries:
        expected = (0o777 if path.is_dir() else 0o666) & ~umask
        assert oct(path.stat().st_mode & 0o777) == oct(expected), path


# Secrets

SECRET = "hunter2"
ADDRESS = f"postgresql://me:{SECRET}@localhost:1/none?sslkey={SECRET}&x=1"


@pytest.mark.parametrize(
    ("text", "masked"),
    [
        ("postgresql://me:p@ss/w@host/db", "postgresql://me:***@host/db"),
        ("https://ghp_abc@host/x", "https://***@host/x"),
        ("https://host/x?a=1&api_token=abc&b=2", "https://host/x?a=1&api_token=***&b=2"),
        ("run 'uri=mysql://u:p@h' and http://h:5000/a?b=c", "run 'uri=mysql://u:***@h' and http://h:5000/a?b=c"),
        ("sqlite:///runs/mlflow.db", "sqlite:///runs/mlflow.db"),
        ("mail me@host: no address", "mail me@host: no address"),
    ],
)
def test_secrets_in_addresses_are_masked(text: str, masked: str) -> None:
    assert mask(text) == masked
    assert mask(masked) == masked
    assert is_masked(masked) == (text != masked)
    assert mask({"a": [text, 1], "b": None}) == {"a": [masked, 1], "b": None}


def files_with(text: str, folder: Path) -> list[str]:
    return [str(path) for path in folder.rglob("*") if path.is_file() and text.encode() in path.read_bytes()]


@pytest.fixture
def mlflow_hears(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses that MLflow's client is opened with; no server answers."""
    mlflow = pytest.importorskip("mlflow")
    heard: list[str] = []

    def client(uri: str) -> None:
        heard.append(uri)
        raise ConnectionError(f"{uri} does not answer")

    monkeypatch.setattr(mlflow, "MlflowClient", client)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return heard


LOGGED = (ROW, *TINY, "logger=[mlflow]", f"logger.mlflow.uri='{ADDRESS}'", "seed=0")


def test_a_password_is_used_and_written_nowhere(
    epo: Epo, mlflow_hears: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert epo("train", *LOGGED, "run_dir=one", "score=test") == 0
    assert epo("train", "-m", *LOGGED, "runs=many", "optimizer.lr=1e25") != 0
    assert epo("sweep", "rpi_main", *LOGGED, "score=test", "optimizer.lr=1e25") == 1
    assert epo("report", "runs=one", "out=report") == 0
    assert epo("config", *LOGGED) == 0
    assert set(mlflow_hears) == {ADDRESS}
    assert "me:***@localhost" in RunFolder(Path("one")).config()["logger"]["mlflow"]["uri"]
    assert files_with(SECRET, tmp_path) == []
    said = capfd.readouterr()  # on stdout Hydra repeats the words of -m
    assert SECRET not in said.err


def test_a_continued_run_gets_the_password_again(
    epo: Epo, mlflow_hears: list[str], refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epo("train", *LOGGED, "run_dir=run") == 0
    RunFolder(Path("run")).update(status="training")
    message = refused("train", "resume=run")
    assert "MLFLOW_TRACKING_URI" in message
    assert "existing=continue" in message
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///another.db")
    assert "MLFLOW_TRACKING_URI" in refused("train", "resume=run")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", ADDRESS)
    assert epo("train", "resume=run") == 0
    RunFolder(Path("run")).update(status="training")
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert epo("train", *LOGGED, "run_dir=run", "existing=continue") == 0
    assert mlflow_hears == [ADDRESS] * 3


def test_reports_mask_secrets_in_records_of_older_versions(tmp_path: Path, epo: Epo) -> None:
    run = make_run(tmp_path / "runs" / "a", "V-LSTM", "marginal", scores(0.3))
    text = run.record_file.read_text()
    run.record_file.write_text(text.replace("epo train", f"epo train logger.mlflow.uri={ADDRESS}"))
    assert epo("report", "runs=runs") == 0
    assert files_with("me:***@localhost", tmp_path / "report")
    assert files_with(SECRET, tmp_path / "report") == []


def test_environment_variables_are_resolved_for_the_configuration_tree_alone(
    epo: Epo, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("A_NAME", SECRET)
    for words in (("train",), ("train", "-m", "seed=0,1"), ("sweep", "rpi_main"), ("config",)):
        assert "environment variables are not resolved" in refused(*words, "title='${oc.env:A_NAME}'")
    tree = tmp_path / "tree" / "experiment"
    tree.mkdir(parents=True)
    (tree / "mine.yaml").write_text("# @package _global_\ntitle: ${oc.env:A_NAME}\n")
    assert epo("train", f"--config-dir={tree.parent}", "experiment=mine", *TINY, "run_dir=run") == 0
    assert RunFolder(Path("run")).record["title"] == SECRET


# Commands


def test_recorded_commands_can_be_given_to_a_shell(epo: Epo) -> None:
    titles = (r"title='it\'s'", "title='a \"quote'", 'title="a\'b"', "title='$HOME `x` !'", "title='two\nlines'")
    for number, title in enumerate(titles):
        changes = (title, f"seed={number}", "score=test")
        assert epo("train", ROW, *TINY, f"run_dir=all/run{number}", *changes) == 0, title
        record = RunFolder(Path(f"all/run{number}")).record
        words = ["epo", "train", ROW, *TINY, *changes, f"--config-dir={tiny.CONF}"]
        assert shlex.split(record["command"]) == words
    assert epo("report", "runs=all") == 0
    assert epo("train", "-m", ROW, *TINY, titles[0], "seed=0") == 0
    (run,) = Path("runs").rglob("run.json")
    words = shlex.split(RunFolder(run.parent).record["command"])
    assert words[-1] == f"--config-dir={tiny.CONF}"
    title = RunFolder(run.parent).record["title"]
    assert title == "it's"
    assert epo("train", *words[2:], "run_dir=again") == 0
    assert RunFolder(Path("again")).record["title"] == title


def test_an_old_command_with_an_unbalanced_quote_stops_no_report(tmp_path: Path, epo: Epo) -> None:
    run = make_run(tmp_path / "runs" / "a", "V-LSTM", "marginal", scores(0.3))
    run.update(command="epo train title='it's trainer.max_epochs=3")
    assert epo("report", "runs=runs") == 0
    assert "trainer.max_epochs=3" in Path("report/results.md").read_text()


# Full disks and read-only folders


@contextmanager
def files_of_at_most(count: int) -> Iterator[None]:
    """A disk on which larger files find no place."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("epo: ")
    return line


def content(folder: str) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="needs a folder in which not even root can write")
def test_a_read_only_folder_is_named_in_one_line(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3))
    commands = (
        ("train", ROW, *TINY, "run_dir=/sys/here"),
        ("sweep", "rpi_main", *TINY, "runs=/sys/here"),
        ("report", "runs=runs", "out=/sys/here"),
    )
    for words in commands:
        capsys.readouterr()
        assert epo(*words) == 1
        assert "/sys/here" in one_line(capsys)


def test_a_full_disk_keeps_the_previous_report(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(Path("runs/a"), "V-LSTM", "marginal", scores(0.3))
    assert epo("report", "runs=runs") == 0
    before = content("report")
    make_run(Path("runs/b"), "V-LSTM", "marginal", scores(0.4), seed=1)
    capsys.readouterr()
    with files_of_at_most(1000):
        assert epo("report", "runs=runs") == 1
    assert "File too large: report/" in one_line(capsys)
    assert content("report") == before


@pytest.mark.slow
def test_a_full_disk_fails_only_the_runs_without_space(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("sweep", "rpi_main", *TINY, "seed=0", "score=test")
    assert epo(*words, "experiment=rpi/const_vel") == 0
    before = content("runs/rpi")
    assert before
    with files_of_at_most(50_000):
        assert epo(*words) == 1
    said = capsys.readouterr()
    assert said.out.count("FAILED, OSError: [Errno 27] File too large: 'runs/rpi/") == 3
    assert "Traceback" not in said.out + said.err
    assert {path: text for path, text in content("runs/rpi").items() if path in before} == before
    assert epo(*words) == 0
    assert "4 runs: 4 done" in capsys.readouterr().out


# The commit of the code


def test_a_commit_is_marked_for_changes_of_code_and_settings_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> str:
        names = ("-c", "user.name=a", "-c", "user.email=a@b")
        return subprocess.run(["git", *names, *words], cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    for file in ("epo_lightning/losses.py", "conf/train.yaml", "pyproject.toml", "README.md"):
        write_file(tmp_path / file, "1\n")
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "one")
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "epo_lightning")
    commit = git("rev-parse", "HEAD").strip()
    write_file(tmp_path / "shipped" / "run.json", "{}")
    write_file(tmp_path / "README.md", "2\n")
    assert provenance.commit() == commit
    for file in ("epo_lightning/new.py", "epo_lightning/losses.py", "conf/train.yaml", "pyproject.toml"):
        write_file(tmp_path / file, "2\n")
        assert provenance.commit() == f"{commit}+", file
        git("stash", "-q", "--include-untracked", "--", file)
        assert provenance.commit() == commit


def test_the_hash_of_the_code_is_that_of_the_files_on_which_results_depend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "epo_lightning"
    for file in ("backbones/mine.py", "report/page.py"):
        (package / file).parent.mkdir(parents=True)
        (package / file).write_text("x = 1\n")
    other = tmp_path / "elsewhere" / "third"
    other.mkdir(parents=True)
    (other / "__init__.py").touch()
    (other / "parts.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path / "elsewhere"))
    monkeypatch.setattr(provenance, "PACKAGE", package)
    (tmp_path / "elsewhere" / "single.py").write_text("x = 1\n")
    names = ("third.parts", "single", "missing.parts")
    found = [EntryPoint(name, name, "epo_lightning.parts") for name in names]
    monkeypatch.setattr(provenance, "entry_points", lambda group: found)
    hashes = [provenance.code.__wrapped__()]
    for file in (package / "backbones" / "mine.py", other / "parts.py", tmp_path / "elsewhere" / "single.py"):
        file.write_text("x = 2\n")
        hashes.append(provenance.code.__wrapped__())
    (other / "parts.py").rename(other / "renamed.py")
    hashes.append(provenance.code.__wrapped__())
    assert len(set(hashes)) == 5
    (package / "report" / "page.py").write_text("x = 2\n")
    (tmp_path / "elsewhere" / "unrelated.py").touch()
    (package / "backbones" / ".#mine.py").symlink_to("me@host.123")  # a lock of Emacs
    (package / "backbones" / "._mine.py").write_text("x = 3\n")  # attributes that macOS keeps beside a file
    (package / "README.md").write_text("words")
    assert provenance.code.__wrapped__() == hashes[-1]


def test_runs_whose_code_was_not_recorded_count_as_runs_of_the_present_code() -> None:
    for record in ({}, {"versions": None}, {"versions": {"torch": "2.7"}}, {"versions": {"code": provenance.code()}}):
        assert not provenance.of_other_code(record)
    assert provenance.of_other_code({"versions": {"code": "another"}})


def test_runs_of_other_code_are_pointed_out(
    epo: Epo, refused: Callable[..., str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sweep keeps them and says so, as does a training in their folder; the report names rows and seeds by their code."""
    words = ("sweep", "rpi_main", *TINY, "score=test")
    assert epo(*words, "experiment=rpi/v_lstm", "seed=0,1") == 0
    assert epo("report", "runs=runs", "scenes=false") == 0
    assert "trained by different code" not in Path("report/results.md").read_text()
    assert "Python file has changed" not in capsys.readouterr().out
    monkeypatch.setattr(provenance, "code", lambda: "other")
    assert epo(*words, "experiment=rpi/v_lstm,rpi/v_lstm_sc", "seed=0,1,2") == 0
    assert (
        "2 of the 2 finished runs are kept although a Python file has changed since they began"
        in capsys.readouterr().out
    )
    assert epo("report", "runs=runs", "scenes=false") == 0
    note = "Runs on tiny were trained by different code"
    assert note in capsys.readouterr().out.replace("\n", " ")
    noted = next(line for line in Path("report/results.md").read_text().splitlines() if line.startswith(note))
    assert "V-LSTM (seed 0, 1); V-LSTM (seed 2), V-LSTM + SC (seed 0, 1, 2)." in noted
    assert epo("evaluate", "runs=runs") == 0
    told = capsys.readouterr().out
    assert "2 of the 6 scored runs were trained by other code than the present one, the first one runs/" in told
    (run,) = (RunFolder(path) for path in Path("runs").rglob("v_lstm/*-s0*"))
    train = ("train", "experiment=rpi/v_lstm", *TINY, "seed=0", f"run_dir={run.path}")
    assert "holds a finished run of other code than the present one: nothing is overwritten" in refused(*train)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert epo(*train, "existing=continue") == 0, "a finished run does not continue"
    run.update(status="training")
    with pytest.warns(UserWarning, match="began with other code than the present one, with which it continues"):
        assert epo("train", f"resume={run.path}") == 0
