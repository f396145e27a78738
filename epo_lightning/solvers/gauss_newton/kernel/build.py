"""Build of the compiled layer: `python -m epo_lightning.solvers.gauss_newton.kernel.build`.

Installing the package does the same.

It takes a C++17 compiler (GCC or Clang: `$CXX`, or the first of c++, g++, clang++) and nothing else, no PyTorch and no
headers of Python's. On x86-64 the sources are compiled for three levels of instructions, and the library chooses when it is
loaded, so that a wheel built on one machine runs on all of them.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
LIBRARY = HERE / "epo_kernel.so.1"  # a plain ".so" would look like a module of Python's
_LEVELS = {"epo_plain": [], "epo_v3": ["-march=x86-64-v3"], "epo_v4": ["-march=x86-64-v4"]}
# Contraction to fused multiply-adds is the only liberty that the compiler may take with the arithmetic.
_FLAGS = ["-std=c++17", "-O3", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-Wno-psabi"]


def fingerprint() -> int:
    """A number that changes with the sources: a library of other sources is not used."""
    digest = hashlib.sha256()
    for path in sorted([*HERE.glob("*.hpp"), *HERE.glob("*.cpp")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")


def load(path: Path = LIBRARY) -> ctypes.CDLL:
    """The library.

    Raises:
        OSError: there is none, it does not load, or it was built from other sources.
    """
    if not path.exists():
        raise OSError(f"{path.name} was not built when the package was installed (it is not in {path.parent})")
    library = ctypes.CDLL(str(path))
    if not hasattr(library, "epo_fingerprint"):
        raise OSError(f"{path} is not the compiled EPO layer")
    library.epo_fingerprint.restype = ctypes.c_int64
    if library.epo_fingerprint() != fingerprint():
        raise OSError(f"{path} was built from other sources than those beside it")
    return library


def _compiler() -> list[str]:
    chosen = shlex.split(os.environ.get("CXX", ""))
    if chosen:
        return chosen
    found = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if found is None:
        raise OSError("no C++ compiler: neither $CXX nor c++, g++ or clang++ was found")
    return [found]


def _run(commands: list[list[str]]) -> None:
    # Side by side: each takes a core for half a minute.
    running = [subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) for c in commands]
    said = [process.communicate()[0] for process in running]
    for process, command, words in zip(running, commands, said, strict=True):
        if process.returncode != 0:
            raise OSError(f"{shlex.join(command)} ended with {process.returncode}\n{words[-2000:]}")


def build() -> None:
    """Compile and link, unless the library is up to date.

    Raises:
        OSError: no compiler, or it refuses; the message holds what it said.
    """
    try:
        load()
        return
    except OSError:
        pass  # none, or a stale one, which is replaced when there is a better one
    compiler = _compiler()
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    levels = _LEVELS if x86 else {"epo_plain": []}
    with tempfile.TemporaryDirectory() as folder:
        compile_ = [*compiler, *_FLAGS, f"-DEPO_FINGERPRINT={fingerprint()}", *(["-DEPO_X86"] if x86 else []), "-c"]
        objects = {f"{folder}/{level}.o": [*flags, f"-DEPO_LEVEL={level}"] for level, flags in levels.items()}
        commands = [[*compile_, *flags, str(HERE / "solve.cpp"), "-o", target] for target, flags in objects.items()]
        commands.append([*compile_, str(HERE / "dispatch.cpp"), "-o", f"{folder}/dispatch.o"])
        _run(commands)
        linked = Path(folder) / LIBRARY.name
        _run([[*compiler, "-shared", *objects, f"{folder}/dispatch.o", "-o", str(linked)]])
        load(linked)
        # Whoever imports at this moment sees the whole library or none.
        partial = LIBRARY.with_suffix(f".{os.getpid()}")
        shutil.copyfile(linked, partial)
        partial.replace(LIBRARY)


if __name__ == "__main__":
    print("building the compiled layer takes a minute or two ...")
    try:
        build()
        print(f"{LIBRARY} is up to date")
    except OSError as error:
        sys.exit(f"the compiled layer was not built: {error}")
