"""Build of the compiled layer: `python -m epo_lightning.solvers.gauss_newton.kernel.build`.

Installing the package runs it too. It needs a C++17 compiler (GCC or Clang: `$CXX`, or the first of c++, g++, clang++),
but neither PyTorch nor Python's headers. On x86-64 there are three levels of instructions. A checkout compiles its sources
for the best one of this machine, which takes a third of the time. A wheel has all three, so that it runs on other machines
as well, and the library chooses one when it is loaded. `--portable`, or EPO_PORTABLE=1 in the environment, builds such a
library in a checkout.

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
import sysconfig
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
LIBRARY = HERE / "epo_kernel.so.1"  # Python would take a plain ".so" for an extension module
SANITIZED = HERE / "epo_kernel.sanitized.so.1"
_LEVELS = {"epo_plain": [], "epo_v3": ["-march=x86-64-v3"], "epo_v4": ["-march=x86-64-v4"]}
"""Options of the compiler for every level, the best one last."""
_NEEDED = {"epo_v3": {"__AVX2__", "__FMA__"}}
_NEEDED["epo_v4"] = _NEEDED["epo_v3"] | {f"__AVX512{part}__" for part in ("F", "BW", "CD", "DQ", "VL")}
"""Macros that a compiler defines for a processor that has the instructions of a level."""
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
        OSError: the file does not exist, cannot be loaded, or was built from other sources or for another processor.
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
    library.epo_levels.restype = ctypes.c_int64
    if library.epo_levels() == 0:
        raise OSError(
            f"{path} was built for a processor with instructions that this one lacks (--portable builds for all)"
        )
    return library


def _compiler() -> list[str]:
    try:
        chosen = shlex.split(os.environ.get("CXX", ""))
    except ValueError as error:
        raise OSError(f"$CXX is {os.environ['CXX']!r}, which is no command: {error}") from None
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


def _native(compiler: list[str]) -> dict[str, list[str]]:
    """The best level that this machine's processor has; all levels if the compiler does not know the processor."""
    asked = [*compiler, "-march=native", "-dM", "-E", "-x", "c++", os.devnull]
    done = subprocess.run(asked, capture_output=True, text=True)
    if done.returncode != 0:
        return _LEVELS
    defined = {line.split()[1] for line in done.stdout.splitlines() if line.startswith("#define ")}
    level = [level for level in _LEVELS if _NEEDED.get(level, set()) <= defined][-1]
    return {level: _LEVELS[level]}


def _serves(target: Path, portable: bool) -> bool:
    """Whether a library is there that was built from these sources, for this machine or, if ``portable``, for all levels."""
    try:
        return load(target).epo_built() == len(_LEVELS) if portable and _x86() else bool(load(target))
    except OSError:
        return False


def _x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def platform_tag() -> str:
    """Tag, as wheels have one, of the platforms that can load the library built here."""
    if sys.platform == "darwin":
        # Python's own name may be one of several processors or of an older macOS, or one that pip does not know.
        from packaging.tags import platform_tags

        return next(platform_tags())
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")


def build(target: Path = LIBRARY, portable: bool = False) -> None:
    """Compile and link, unless the library is up to date.

    Args:
        target: :data:`LIBRARY`, or :data:`SANITIZED` for one with sanitizers.
        portable: whether the library has all levels of instructions, or only the best one of this machine; true if the
            environment says EPO_PORTABLE=1.

    Raises:
        OSError: there is no compiler, or it fails; the message holds its output.
    """
    sanitized = target == SANITIZED
    portable = portable or os.environ.get("EPO_PORTABLE") == "1"
    if not sanitized and _serves(target, portable):
        return  # a missing or stale one is replaced once the new one has been built
    compiler = [_found("clang++")] if sanitized else _compiler()
    if sanitized:
        levels = {"epo_plain": ["-march=native"]}
    elif not _x86():
        levels = {"epo_plain": []}
    else:
        levels = _LEVELS if portable else _native(compiler)
    options = [*_FLAGS, *(_SANITIZE if sanitized else _FAST)]
    with tempfile.TemporaryDirectory() as folder:
        built = [f"-DHAS_{level.upper()}" for level in levels]
        compile_ = [*compiler, *options, f"-DEPO_FINGERPRINT={fingerprint()}", *built, "-c"]
        sources = {f"{folder}/dispatch.o": [str(HERE / "dispatch.cpp")]}
        for level, flags in levels.items():
            for name in ("solve", "lq_game", "feedback", "feedback_derivative"):
                sources[f"{folder}/{level}.{name}.o"] = [*flags, f"-DEPO_LEVEL={level}", str(HERE / f"{name}.cpp")]
        _run([[*compile_, *source, "-o", object_] for object_, source in sources.items()])
        linked = Path(folder) / target.name
        _run([[*compiler, *options, "-shared", *sources, "-o", str(linked)]])
        if not sanitized:  # a sanitized library loads only where the sanitizers' runtime was loaded first
            load(linked)
        # Replaced at once, so that a process that loads it meanwhile gets a whole library.
        partial = target.with_suffix(f".{os.getpid()}")
        shutil.copyfile(linked, partial)
        partial.replace(target)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--portable", action="store_true", help="build for every processor, not only for this one")
    parser.add_argument("--sanitize", action="store_true", help=f"build {SANITIZED.name}, with ASan and UBSan")
    arguments = parser.parse_args()
    target = SANITIZED if arguments.sanitize else LIBRARY
    try:
        print("the compiled layer is built unless it is up to date, which takes a minute or two ...")
        build(target, arguments.portable)
        print(f"{target} is ready")
    except OSError as error:
        sys.exit(f"the compiled layer was not built: {error}")


if __name__ == "__main__":
    main()
