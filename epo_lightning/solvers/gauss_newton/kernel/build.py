"""Build of the compiled layer: `python -m epo_lightning.solvers.gauss_newton.kernel.build`.

Installing the package runs it too. It needs a C++17 compiler (GCC or Clang: `$CXX`, or the first of c++, g++, clang++), but
neither PyTorch nor Python's headers. On x86-64 the sources are compiled for three levels of instructions, and the library
chooses one when it is loaded, so that a wheel built on one machine runs on all of them.

`--sanitize` builds a second library with AddressSanitizer and UndefinedBehaviorSanitizer, which `make asan` tests.
"""

from __future__ import annotations

import argparse
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
LIBRARY = HERE / "epo_kernel.so.1"  # Python would take a plain ".so" for an extension module
SANITIZED = HERE / "epo_kernel.sanitized.so.1"
_LEVELS = {"epo_plain": [], "epo_v3": ["-march=x86-64-v3"], "epo_v4": ["-march=x86-64-v4"]}
# Contraction to fused multiply-adds is the only change of the arithmetic that the compiler may make.
_FLAGS = [
    "-std=c++17",
    "-pthread",
    "-fPIC",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-Wno-psabi",
]
_FAST = ["-O3"]
# Clang only: with its sanitizers on, GCC 12 compiles vector types to wrong gradients.
_SANITIZE = ["-O1", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-shared-libsan"]


def fingerprint() -> int:
    """Hash of the sources; a library built from other sources is not used."""
    digest = hashlib.sha256()
    for path in sorted([*HERE.glob("*.hpp"), *HERE.glob("*.cpp")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")


def load(path: Path | None = None) -> ctypes.CDLL:
    """The library: the given one, the one that the environment variable ``EPO_KERNEL`` names, or the installed one.

    Raises:
        OSError: the file does not exist, cannot be loaded, or was built from other sources.
    """
    path = path or Path(os.environ.get("EPO_KERNEL") or LIBRARY)
    if not path.exists():
        if path != LIBRARY:
            raise OSError(f"{path}, which the environment variable EPO_KERNEL names, does not exist")
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
    return chosen or [_found("c++", "g++", "clang++")]


def _found(*names: str) -> str:
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        raise OSError(f"no C++ compiler: {' or '.join(names)} was not found, and $CXX names none")
    return found


def _run(commands: list[list[str]]) -> None:
    # In parallel: each takes a core for half a minute.
    running = [subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) for c in commands]
    said = [process.communicate()[0] for process in running]
    for process, command, words in zip(running, commands, said, strict=True):
        if process.returncode != 0:
            raise OSError(f"{shlex.join(command)} ended with {process.returncode}\n{words[-2000:]}")


def build(target: Path = LIBRARY) -> None:
    """Compile and link, unless the library is up to date.

    Args:
        target: :data:`LIBRARY`, or :data:`SANITIZED` for one with sanitizers.

    Raises:
        OSError: there is no compiler, or it fails; the message holds its output.
    """
    sanitized = target == SANITIZED
    if not sanitized:
        try:
            load(target)
            return
        except OSError:
            pass  # missing or stale: it is replaced once the new one has been built
    compiler = [_found("clang++")] if sanitized else _compiler()
    x86 = platform.machine().lower() in ("x86_64", "amd64") and not sanitized
    # A sanitized library runs where it was built: one level of instructions, the machine's own.
    levels = _LEVELS if x86 else {"epo_plain": ["-march=native"] if sanitized else []}
    options = [*_FLAGS, *(_SANITIZE if sanitized else _FAST)]
    with tempfile.TemporaryDirectory() as folder:
        compile_ = [*compiler, *options, f"-DEPO_FINGERPRINT={fingerprint()}", *(["-DEPO_X86"] if x86 else []), "-c"]
        objects = {f"{folder}/{level}.o": [*flags, f"-DEPO_LEVEL={level}"] for level, flags in levels.items()}
        commands = [[*compile_, *flags, str(HERE / "solve.cpp"), "-o", object_] for object_, flags in objects.items()]
        commands.append([*compile_, str(HERE / "dispatch.cpp"), "-o", f"{folder}/dispatch.o"])
        _run(commands)
        linked = Path(folder) / target.name
        _run([[*compiler, *options, "-shared", *objects, f"{folder}/dispatch.o", "-o", str(linked)]])
        if not sanitized:  # a sanitized library loads only where the sanitizers' runtime was loaded first
            load(linked)
        # Replaced at once, so that a process that loads it meanwhile gets a whole library.
        partial = target.with_suffix(f".{os.getpid()}")
        shutil.copyfile(linked, partial)
        partial.replace(target)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sanitize", action="store_true", help=f"build {SANITIZED.name}, with ASan and UBSan")
    target = SANITIZED if parser.parse_args().sanitize else LIBRARY
    print("building the compiled layer takes a minute or two ...")
    try:
        build(target)
        print(f"{target} is up to date")
    except OSError as error:
        sys.exit(f"the compiled layer was not built: {error}")


if __name__ == "__main__":
    main()
